"""Pages that the live view serves itself, beside the 3D client of viser.

- `/`: the 3D client with a bar on top that shows the state of the robot in words (`status_bar.js`).
- `/text`: the same words without JavaScript and WebGL, loaded again every second. The 3D client draws its panel in the
  loop of the 3D scene, so a browser without WebGL shows no panel at all; the bar leads such a browser here.
- `/status`: the words as JSON, for the bar.
- `/estop`: sends the emergency stop and leads back to `/text`. It needs no code, as on the gatekeeper's socket.
- `/instruction`: receives the text of the field in the bar (`instruction_form.js`) in a header field, because the
  server reads no body. A page of another site cannot set such a field without a permission, which is never given.

The pages are prepared by the view; a request only reads them, so that many viewers cost little.
"""

from __future__ import annotations

import gzip
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from threading import Thread
from urllib.parse import unquote

import msgspec

from dualbrain.visualization.html.page import Html, element, join
from dualbrain.visualization.live.operator.operator_status import STARTING, OperatorState, OperatorStatus

PLAIN_TEXT = "text/plain; charset=utf-8"
STALE_AFTER_S = 2.0
"""Age of the newest state [s] above which the bar does not show it any more."""
STALE = OperatorStatus(
    state=OperatorState.STOPPED,
    reason="The control program has sent no state for more than 2 s. The robot may still move.",
    next_action="Keep clear. If it stays so, press the emergency stop and look at the terminal.",
)
FAILED = OperatorStatus(
    state=OperatorState.STOPPED,
    reason="The live view cannot show the newest state. The robot may still move.",
    next_action=STALE.next_action,
)
"""The status while the words of the newest state cannot be made."""
IMAGE_FAILED = "The image is old, because it cannot be drawn; these words are new. Look at the terminal."
REFRESH_S = 1
ESTOP_PATH, INSTRUCTION_PATH = "/estop", "/instruction"
TEXT_FIELD, PAGE_FIELD = "X-Dualbrain-Text", "X-Dualbrain-Page"
"""Header fields of an instruction: its text in percent encoding, and the token of its page."""
EnterCallback = Callable[[str, str], str]
"""Receives the token of a page and an instruction; returns "" or the reason of a refusal, without waiting."""


@dataclass(frozen=True, slots=True, kw_only=True)
class PageResponse:
    """A response: HTTP status, media type, body, and more header fields."""

    status: int
    media_type: str
    body: bytes
    headers: dict[str, str] = field(default_factory=dict[str, str])


class OwnPages:
    """The pages of one live view; `publish` may be called from any thread."""

    def __init__(
        self, emergency_stop: Callable[[], str] | None = None, clock: Callable[[], float] = time.monotonic
    ) -> None:
        """Start before the first state; with `emergency_stop` the pages have a button for it. `clock` returns [s]."""
        self._emergency_stop, self._clock = emergency_stop, clock
        self._status: OperatorStatus = STARTING
        self._numbers: Callable[[], str] = str
        self._published_at, self._ended, self._expires, self._notice = clock(), False, False, ""
        self.image_problem = ""
        self.enter_instruction: EnterCallback | None = None

    def publish(
        self, status: OperatorStatus, numbers: Callable[[], str], *, expires: bool, ended: bool = False
    ) -> None:
        """Show `status` from now on, and on the text page the HTML table that `numbers` makes.

        A status that `expires`, that of a robot that moves or reports at rest too, is not shown any more after
        `STALE_AFTER_S` without another. `image_problem` is shown beside every status.
        """
        self._status, self._numbers, self._ended, self._expires = status, numbers, ended, expires
        self._published_at = self._clock()

    def receive_instruction(self, texts: Sequence[str], tokens: Sequence[str]) -> PageResponse:
        """Enter an instruction, with all values of the two header fields; the body is the reason of a refusal."""
        if self.enter_instruction is None:
            return PageResponse(status=404, media_type=PLAIN_TEXT, body=b"There is no field for instructions here.\n")
        if len(texts) != 1 or len(tokens) != 1:
            return PageResponse(status=400, media_type=PLAIN_TEXT, body=b"Use the field in the bar of the page.\n")
        reason = self.enter_instruction(tokens[0], unquote(texts[0], errors="replace"))
        return PageResponse(status=200, media_type=PLAIN_TEXT, body=reason.encode("utf-8", "replace"))

    def respond(self, path: str, *, accepts_gzip: bool) -> PageResponse | None:
        """The response to a request for `path`, None if it is not a page of this class."""
        match path.partition("?")[0]:
            case "/status":
                return PageResponse(status=200, media_type="application/json", body=self._status_json())
            case "/text":
                return PageResponse(
                    status=200, media_type="text/html; charset=utf-8", body=self._text_page().encode("utf-8", "replace")
                )
            case "/estop":
                if self._emergency_stop is None:
                    return PageResponse(status=404, media_type=PLAIN_TEXT, body=b"There is no emergency stop here.\n")
                Thread(target=self._stop, args=(self._emergency_stop,), name="emergency stop", daemon=True).start()
                return PageResponse(status=303, media_type=PLAIN_TEXT, body=b"sent\n", headers={"Location": "/text"})
            case "/" | "/index.html":
                plain, compressed = index_page()
                return PageResponse(
                    status=200,
                    media_type="text/html; charset=utf-8",
                    body=compressed if accepts_gzip else plain,
                    headers={"Content-Encoding": "gzip"} if accepts_gzip else {},
                )
            case _:
                return None

    def _stop(self, emergency_stop: Callable[[], str]) -> None:
        self._notice = emergency_stop()

    def _current(self) -> OperatorStatus:
        stale = self._expires and self._clock() - self._published_at > STALE_AFTER_S
        return STALE if stale else self._status

    def _status_json(self) -> bytes:
        status = self._current()
        return msgspec.json.encode(
            {
                "state": status.state.name,
                "word": status.state.value,
                "reason": status.reason,
                "next": " ".join(filter(None, (status.next_action, self.image_problem, self._notice))),
                "steps": status.steps,
                "can_stop": self._emergency_stop is not None,
                "can_instruct": self.enter_instruction is not None,
                "ended": self._ended,
            }
        )

    def _text_page(self) -> str:
        status = self._current()
        stop = [element("p", element("a", "EMERGENCY STOP", href=ESTOP_PATH, class_="stop"))]
        head = element(
            "head",
            element("meta", charset="utf-8"),
            element("meta", http_equiv="refresh", content=f"{REFRESH_S}; url=/text"),
            element("meta", name="viewport", content="width=device-width, initial-scale=1"),
            element("title", f"{status.state.value} – dualbrain"),
            element("style", Html(_own_file("text_page.css") + _own_file("panel.css"))),
        )
        main = element(
            "main",
            element("p", status.reason, id="reason"),
            element("p", element("b", status.next_action), id="next"),
            element("ol", *(element("li", step) for step in status.steps)) if status.steps else Html(""),
            join(stop if self._emergency_stop is not None else []),
            element("p", self._notice),
            Html(self._numbers()),
            element("p", element("a", "3D view (needs WebGL)", href="/")),
        )
        title = element("h1", status.state.value, id="state", class_=status.state.name)
        return f"<!doctype html>\n{element('html', head, element('body', title, main), lang='en')}\n"


@cache
def index_page() -> tuple[bytes, bytes]:
    """The page of the 3D client with the bar in its head, plain and compressed.

    Raises:
        FileNotFoundError: the installed viser has no built client.
    """
    client = resources.files("viser").joinpath("client", "build", "index.html").read_text("utf-8")
    style = "".join(_own_file(name) for name in ("status_bar.css", "instruction_form.css", "panel.css"))
    script = _own_file("status_bar.js") + _own_file("instruction_form.js")
    own = f"<head><style>{style}</style><script>{script}</script>"
    page = client.replace("<head>", own, 1).replace("<title>Viser</title>", "<title>dualbrain</title>", 1)
    data = page.encode("utf-8", "surrogatepass")
    return data, gzip.compress(data, 6)


def _own_file(name: str) -> str:
    return resources.files("dualbrain.visualization.live.web").joinpath(name).read_text("utf-8")
