"""The live page refuses foreign web pages: in the upgrade, for every file, and in a real browser."""

import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import msgspec
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import load_robot
from dualbrain.visualization.live import view as live_view
from dualbrain.visualization.live.connection_guard import guard_is_active
from dualbrain.visualization.live.operator_buttons import OperatorAccess
from dualbrain.visualization.live.view import LiveView, start_server
from tests.visualization.headless_browser import Browser
from tests.visualization.raw_handshake import exchange, upgrade_lines

MARKER = "the scene that is shown"


class View:
    """A live view with operator buttons, and the actions that were sent."""

    def __init__(self, port: int) -> None:
        robot_model = load_robot("panda")
        self.sent: list[str] = []
        access = OperatorAccess(lambda action, speed: self.sent.append(action) or "", "the-code")
        small = msgspec.structs.replace(robot_model, spheres=robot_model.spheres[::12])
        self.view = LiveView(small, port, access=access, instruction=MARKER)
        self.port = self.view.port


@pytest.fixture(scope="module")
def shown() -> Iterator[View]:
    one = View(18160)
    yield one
    one.view.close()


OWN_HOSTS = ("127.0.0.1:{port}", "localhost:{port}", "LOCALHOST:{port}")
FOREIGN_HOSTS = (
    "evil.example",
    "evil.example:{port}",
    "127.0.0.1.nip.io:{port}",
    "localhost.evil.example:{port}",
    "127.0.0.1:{port}.evil.example",
    "evil.example@127.0.0.1:{port}",
    "127.0.0.1:{port}, evil.example",
    "127.0.0.1:1",
    "127.0.0.1:{port}1",
    "127.0.0.1:",
    "0.0.0.0:{port}",
    "[::1]:{port}",
    "[::ffff:127.0.0.1]:{port}",
    "127.1:{port}",
    "2130706433:{port}",
    "localhost.:{port}",
    "xn--localhost:{port}",
    "192.168.0.7:{port}",
    "",
)
FOREIGN_ORIGINS = (
    "https://evil.example",
    "http://evil.example:{port}",
    "null",
    "",
    "file://",
    "http://127.0.0.1",
    "http://127.0.0.1:1",
    "http://localhost:{port}",
    "https://127.0.0.1:{port}",
    "http://127.0.0.1:{port}/",
    "http://127.0.0.1:{port}.evil.example",
    "http://127.0.0.1:{port}@evil.example",
    "http://evil.example http://127.0.0.1:{port}",
    "ws://127.0.0.1:{port}",
    "chrome-extension://abcdefgh",
)


@pytest.mark.parametrize("host", OWN_HOSTS)
def test_the_own_page_and_programs_of_this_machine_are_connected(shown: View, host: str) -> None:
    host = host.format(port=shown.port)
    for origin in (f"http://{host}", f"http://{host.lower()}", None):
        status, _, first = exchange(shown.port, upgrade_lines(host, origin))
        assert (status, first != b"") == (101, True)
    assert exchange(shown.port, [f"Host: {host}"])[0] == 200
    name = host.partition(":")[0]
    assert exchange(shown.port, upgrade_lines(name, None))[0] == 101, "a program may leave the port out, a page may not"
    assert exchange(shown.port, upgrade_lines(name, f"http://{name}"))[0] == 403


@pytest.mark.parametrize("host", [*FOREIGN_HOSTS, None])
def test_a_foreign_host_is_refused(shown: View, host: str | None) -> None:
    host = host if host is None else host.format(port=shown.port)
    for origin in (f"http://{host}", f"http://127.0.0.1:{shown.port}", None):
        status, _, first = exchange(shown.port, upgrade_lines(host, origin))
        assert status in (400, 403), "DNS rebinding makes a foreign name an address of this machine"
        assert first in (b"R", b"F", b"I", b"")
    assert exchange(shown.port, [f"Host: {host}"] if host is not None else [])[0] in (400, 403)


@pytest.mark.parametrize("origin", FOREIGN_ORIGINS)
def test_a_foreign_origin_is_refused_in_the_upgrade(shown: View, origin: str) -> None:
    host, origin = f"127.0.0.1:{shown.port}", origin.format(port=shown.port)
    assert exchange(shown.port, upgrade_lines(host, origin))[0] == 403
    assert exchange(shown.port, [f"Host: {host}", f"Origin: {origin}"])[0] == 403
    for path in ("/?websocket=1", "/index.html", f"//127.0.0.1:{shown.port}/", f"http://127.0.0.1:{shown.port}/"):
        assert exchange(shown.port, upgrade_lines(host, origin), path)[0] == 403


def test_repeated_fields_are_refused(shown: View) -> None:
    host, own = f"127.0.0.1:{shown.port}", f"http://127.0.0.1:{shown.port}"
    for lines in (
        upgrade_lines(host, own, "Origin: https://evil.example"),
        upgrade_lines(host, "https://evil.example", f"Origin: {own}"),
        upgrade_lines(host, own, "Host: evil.example"),
        upgrade_lines("evil.example", own, f"Host: {host}"),
        upgrade_lines(host, "https://evil.example", f"X-Forwarded-Host: {host}", f"Sec-WebSocket-Origin: {own}"),
    ):
        assert exchange(shown.port, lines)[0] == 403


@pytest.mark.parametrize("site", ["cross-site", "same-site", "other"])
def test_a_foreign_page_cannot_embed_or_read_a_file(shown: View, site: str) -> None:
    host = f"Host: 127.0.0.1:{shown.port}"
    fetch = [f"Sec-Fetch-Site: {site}", "Sec-Fetch-Mode: navigate", "Sec-Fetch-Dest: "]
    for kind in ("iframe", "frame", "embed", "object", "script", "image"):
        assert exchange(shown.port, [host, *fetch[:2], fetch[2] + kind])[0] == 403
    assert exchange(shown.port, [host, fetch[0]])[0] == 403
    assert exchange(shown.port, [host, *fetch[:2], f"{fetch[2]}document"])[0] == 200, "a link to the page"
    assert exchange(shown.port, upgrade_lines(f"127.0.0.1:{shown.port}", None, fetch[0]))[0] == 403


def test_every_response_forbids_frames_and_other_servers(shown: View) -> None:
    host = f"127.0.0.1:{shown.port}"
    for lines, path in (([f"Host: {host}"], "/"), ([f"Host: {host}"], "/none"), (["Host: evil.example"], "/")):
        _, fields, _ = exchange(shown.port, lines, path)
        policy = fields["content-security-policy"]
        assert "frame-ancestors 'none'" in policy
        assert f"connect-src 'self' ws://{host} " in policy
        assert (fields["x-frame-options"], fields["cross-origin-resource-policy"]) == ("DENY", "same-origin")


def test_the_robot_viewer_is_guarded_and_another_server_is_not_touched() -> None:
    server = start_server(18190)
    try:
        assert guard_is_active(18190)
        assert exchange(18190, upgrade_lines("127.0.0.1:18190", "https://evil.example"))[0] == 403
    finally:
        server.stop()
    from websockets.asyncio import server as websocket_server  # noqa: PLC0415

    assert websocket_server.serve.__module__ == "websockets.asyncio.server"


def test_a_server_without_the_guard_is_not_started(monkeypatch: pytest.MonkeyPatch) -> None:
    from contextlib import nullcontext  # noqa: PLC0415

    monkeypatch.setattr(live_view, "guard_new_servers", nullcontext)
    with pytest.raises(ConfigurationError, match="foreign web pages"):
        start_server(18195)
    assert not guard_is_active(18195)


# --- in a browser -----------------------------------------------------------------------------------------------------

FOREIGN_PAGE = """<!doctype html><title>foreign</title><iframe id="frame" src="http://127.0.0.1:%(port)d/"></iframe>
<script>
const state = window.state = {sockets: {}, read: {}, framed: null};
for (const host of ['127.0.0.1', 'localhost']) {
  const socket = new WebSocket('ws://' + host + ':%(port)d/', ['viser-v%(version)s']);
  socket.binaryType = 'arraybuffer';
  socket.onmessage = () => { state.sockets[host] = 'watched'; };
  socket.onclose = () => { state.sockets[host] = state.sockets[host] || 'refused'; };
  fetch('http://' + host + ':%(port)d/', {mode: 'no-cors'})
    .then(reply => { state.read[host] = reply.type; }).catch(() => { state.read[host] = 'refused'; });
}
</script>"""
FOREIGN_RESULT = """
const state = window.state;
return state && Object.keys(state.sockets).length == 2 && Object.keys(state.read).length == 2 && state;"""
FRAME_TEXT = "return document.body.textContent + document.title + document.querySelectorAll('button').length"


class _ForeignPage(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        body = self.server.page.encode()
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, format: str, *args: object) -> None:
        """Write no log."""


@pytest.fixture
def foreign_site(shown: View) -> Iterator[int]:
    from importlib.metadata import version  # noqa: PLC0415

    with ThreadingHTTPServer(("127.0.0.1", 0), _ForeignPage) as server:
        server.page = FOREIGN_PAGE % {"port": shown.port, "version": version("viser")}
        threading.Thread(target=server.serve_forever, daemon=True).start()
        yield server.server_address[1]
        server.shutdown()


def test_a_foreign_page_in_a_browser_neither_watches_nor_presses(
    shown: View, foreign_site: int, tmp_path: Path
) -> None:
    """The same page on another port, under a foreign name, and under a foreign name with the port of the view."""
    rules = "--host-resolver-rules=MAP evil.example 127.0.0.1"
    with Browser(tmp_path / "profile", (700, 500), rules) as browser:
        for url in (f"http://127.0.0.1:{foreign_site}/", f"http://evil.example:{foreign_site}/"):
            browser.open(url)
            state = browser.wait_for(FOREIGN_RESULT, 60.0)
            assert state["sockets"] == {"127.0.0.1": "refused", "localhost": "refused"}
            assert state["read"] == {"127.0.0.1": "refused", "localhost": "refused"}
            assert browser.execute_script("return window.frames.length") == 1
            browser.enter_frame(0)
            assert "EMERGENCY" not in browser.execute_script(FRAME_TEXT)
            assert browser.execute_script("return document.querySelectorAll('button, canvas').length") == 0
            browser.leave_frame()
        browser.open(f"http://evil.example:{shown.port}/")  # DNS rebinding
        assert "Refused" in browser.execute_script("return document.body.textContent")
    assert shown.sent == []


def test_the_page_connects_to_no_other_server(shown: View, tmp_path: Path) -> None:
    """viser takes the address of a server from the query; that server could run scripts in the page."""
    asked: list[str] = []

    class Recorder(_ForeignPage):
        def do_GET(self) -> None:
            asked.append(self.path)

    with ThreadingHTTPServer(("127.0.0.1", 0), Recorder) as server:
        threading.Thread(target=server.serve_forever, daemon=True).start()
        port = server.server_address[1]
        with Browser(tmp_path / "profile", (700, 500)) as browser:
            browser.open(f"{shown.view.url}/?websocket=ws://127.0.0.1:{port}/&playbackPath=http://127.0.0.1:{port}/x")
            browser.wait_for("return document.querySelectorAll('#root *').length > 0", 60.0)
            browser.execute_script(f"fetch('http://127.0.0.1:{port}/y').catch(() => {{ window.blocked = 1; }})")
            browser.wait_for("return window.blocked", 30.0)
        server.shutdown()
    assert asked == []
