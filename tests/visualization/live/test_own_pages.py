"""Pages beside the 3D client: words as JSON and as text, stale states, the emergency stop, foreign links."""

import re
import threading
from importlib import resources
from types import SimpleNamespace

import msgspec
import pytest
from websockets.datastructures import Headers

from dualbrain.visualization.live.connection_guard import _refuse_action
from dualbrain.visualization.live.operator.operator_status import STARTING, OperatorState, Situation, describe_situation
from dualbrain.visualization.live.web.own_pages import STALE, STALE_AFTER_S, OwnPages, index_page

MOVING = describe_situation(Situation(in_contract=True, phase="carry"))
ESTOP = describe_situation(Situation(action="ESTOP", check="estop"))


class Clock:
    """A clock that the test moves [s]."""

    now = 0.0

    def __call__(self) -> float:
        return self.now


def status_of(pages: OwnPages) -> dict:
    return msgspec.json.decode(pages.respond("/status", accepts_gzip=False).body)


def text_of(pages: OwnPages) -> str:
    return pages.respond("/text", accepts_gzip=False).body.decode()


def test_the_words_are_published_as_json_and_as_text():
    pages = OwnPages()
    pages.publish(ESTOP, lambda: "<table id='numbers'></table>", expires=False)
    status, text = status_of(pages), text_of(pages)
    assert (status["word"], status["reason"], tuple(status["steps"])) == ("EMERGENCY STOP", ESTOP.reason, ESTOP.steps)
    for words in (status["word"], ESTOP.reason, "id='numbers'", "release the emergency stop"):
        assert words in text
    assert "<script" not in text


def test_an_old_state_of_a_moving_robot_is_not_shown_and_a_result_is():
    clock = Clock()
    pages = OwnPages(clock=clock)
    assert status_of(pages)["reason"] == STARTING.reason
    pages.publish(MOVING, str, expires=True)
    clock.now += 0.9 * STALE_AFTER_S
    assert status_of(pages)["word"] == "MOVING"
    clock.now += 0.2 * STALE_AFTER_S
    assert status_of(pages)["reason"] == STALE.reason
    pages.publish(MOVING, str, expires=False)
    clock.now += 1e6
    assert status_of(pages)["word"] == "MOVING"


def test_untrusted_words_are_escaped():
    pages = OwnPages()
    pages.publish(describe_situation(Situation(result="<img src=x onerror=alert(1)>")), str, expires=False)
    assert "<img" not in text_of(pages)


def test_the_emergency_stop_is_sent_at_once_without_waiting_for_its_result():
    sent, answered, ended = threading.Event(), threading.Event(), threading.Event()

    def stop() -> str:
        sent.set()
        answered.wait(5.0)
        ended.set()
        return "there is no gatekeeper"

    pages = OwnPages(stop)
    response = pages.respond("/estop", accepts_gzip=False)
    assert not ended.is_set()
    assert (response.status, response.headers["Location"]) == (303, "/text")
    assert sent.wait(10.0)
    answered.set()
    for _ in range(1000):
        if "there is no gatekeeper" in text_of(pages):
            break
        threading.Event().wait(0.01)
    assert "there is no gatekeeper" in status_of(pages)["next"]


def test_without_an_emergency_stop_there_is_no_button():
    pages = OwnPages()
    assert pages.respond("/estop", accepts_gzip=False).status == 404
    assert not status_of(pages)["can_stop"]
    assert "EMERGENCY STOP" not in text_of(pages)


@pytest.mark.parametrize("path", ["/estop?x", "/instruction"])
@pytest.mark.parametrize("site", ["cross-site", "same-site", "same-origin", "none"])
def test_a_link_of_a_foreign_page_neither_stops_the_robot_nor_gives_an_instruction(site, path):
    request = SimpleNamespace(path=path, headers=Headers({"Sec-Fetch-Site": site}))
    assert bool(_refuse_action(request)) is (site in ("cross-site", "same-site"))


def test_the_client_page_contains_the_bar_and_names_the_project():
    plain, compressed = index_page()
    assert b"db-bar" in plain[:20_000], "before the scripts of the client"
    assert b"<title>dualbrain</title>" in plain
    assert len(compressed) < len(plain)
    assert OwnPages().respond("/?darkMode", accepts_gzip=False).body == plain


def test_other_paths_belong_to_the_client():
    assert OwnPages().respond("/assets/x.js", accepts_gzip=True) is None


@pytest.mark.parametrize("file", ["status_bar.css", "text_page.css"])
def test_every_state_has_a_colour_of_its_own_with_readable_text(file: str) -> None:
    style = resources.files("dualbrain.visualization.live.web").joinpath(file).read_text("utf-8")
    grounds = set()
    for state in OperatorState:
        rule = re.search(rf"\.{state.name} \{{([^}}]*)\}}", style)
        assert rule, state
        ground = re.search(r"background: (#\w{6})", rule[1])
        text = re.search(r"(?<![-\w])color: (#\w{3,6})", rule[1])
        assert ground
        grounds.add(ground[1])
        assert contrast(ground[1], text[1] if text else "#fff") >= 4.5
    assert len(grounds) == len(OperatorState)


def contrast(one: str, other: str) -> float:
    """Contrast ratio of two colours (WCAG 2)."""
    low, high = sorted((luminance(one), luminance(other)))
    return (high + 0.05) / (low + 0.05)


def luminance(colour: str) -> float:
    digits = colour[1:] if len(colour) == 7 else "".join(2 * digit for digit in colour[1:])
    shares = [int(digits[k : k + 2], 16) / 255 for k in (0, 2, 4)]
    linear = [share / 12.92 if share <= 0.04045 else ((share + 0.055) / 1.055) ** 2.4 for share in shares]
    return 0.2126 * linear[0] + 0.7152 * linear[1] + 0.0722 * linear[2]


def test_an_instruction_is_one_text_of_one_page():
    pages, entered = OwnPages(), []
    assert pages.receive_instruction(["stop"], ["t"]).status == 404
    pages.enter_instruction = lambda token, text: entered.append((token, text)) or "a reason"
    assert status_of(pages)["can_instruct"]
    for texts, tokens in (([], ["t"]), (["stop"], []), (["a", "b"], ["t"]), (["a"], ["t", "u"])):
        assert pages.receive_instruction(texts, tokens).status == 400
    assert entered == []
    response = pages.receive_instruction(["gr%C3%BCn %F0%9F%A7%8A %ff"], ["t"])
    assert (response.status, response.body) == (200, b"a reason")
    assert entered == [("t", "gr\u00fcn \U0001f9ca \ufffd")]
