"""Pages beside the 3D client: words as JSON and as text, stale states, the emergency stop, foreign links."""

import threading
from types import SimpleNamespace

import msgspec
import pytest
from websockets.datastructures import Headers

from dualbrain.visualization.live.connection_guard import _refuse_stop
from dualbrain.visualization.live.operator.operator_status import STARTING, Situation, describe_situation
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
    sent, answered = threading.Event(), threading.Event()

    def stop() -> str:
        sent.set()
        answered.wait(10.0)
        return "there is no gatekeeper"

    pages = OwnPages(stop)
    response = pages.respond("/estop", accepts_gzip=False)
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


@pytest.mark.parametrize("site", ["cross-site", "same-site", "same-origin", "none"])
def test_a_link_of_a_foreign_page_cannot_stop_the_robot(site):
    request = SimpleNamespace(path="/estop?x", headers=Headers({"Sec-Fetch-Site": site}))
    assert bool(_refuse_stop(request)) is (site in ("cross-site", "same-site"))


def test_the_client_page_contains_the_bar_and_names_the_project():
    plain, compressed = index_page()
    assert b"db-bar" in plain[:20_000], "before the scripts of the client"
    assert b"<title>dualbrain</title>" in plain
    assert len(compressed) < len(plain)
    assert OwnPages().respond("/?darkMode", accepts_gzip=False).body == plain


def test_other_paths_belong_to_the_client():
    assert OwnPages().respond("/assets/x.js", accepts_gzip=True) is None
