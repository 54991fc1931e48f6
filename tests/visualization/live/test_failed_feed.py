"""A view that cannot draw, or gets no state any more, states that on the page, and works again with the next state."""

import time
from collections.abc import Callable, Iterator

import msgspec
import pytest

from dualbrain.control.recording.trace import Trace
from dualbrain.robots.loader import load_robot
from dualbrain.visualization.live import view as view_module
from dualbrain.visualization.live.view import LiveView
from dualbrain.visualization.live.view_state import ViewState
from dualbrain.visualization.live.web.own_pages import FAILED, IMAGE_FAILED, STALE, STALE_AFTER_S
from tests.visualization.conftest import scene
from tests.visualization.sample_view_states import view_state_at

PANDA = load_robot("panda")


@pytest.fixture
def view() -> Iterator[LiveView]:
    made = LiveView(PANDA, 18140)
    yield made
    made.close()


def at_rest(*, is_periodic: bool = False) -> ViewState:
    return ViewState(t=0.0, frames={}, scene=scene(), is_periodic=is_periodic)


def status_of(view: LiveView) -> dict[str, str]:
    return msgspec.json.decode(view._pages.respond("/status", accepts_gzip=False).body)


def wait_for(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 10.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.01)


def fail(*arguments: object) -> None:
    raise RuntimeError("no such mesh")


def test_an_image_that_cannot_be_drawn_is_stated_beside_the_words_until_one_is_drawn(view, trace: Trace, monkeypatch):
    monkeypatch.setattr(view._server, "get_clients", lambda: {0: None})
    with monkeypatch.context() as patched:
        patched.setattr(view._robot, "update", fail)
        view.show(view_state_at(PANDA, trace, scene(), 9000))
        wait_for(lambda: IMAGE_FAILED in status_of(view)["next"])
    view.show(view_state_at(PANDA, trace, scene(), 9001))
    wait_for(lambda: IMAGE_FAILED not in status_of(view)["next"])


def test_words_that_cannot_be_made_are_stated_until_those_of_another_state_are(view, monkeypatch):
    with monkeypatch.context() as patched:
        patched.setattr(view._status, "update", fail)
        view.show(at_rest())
        wait_for(lambda: status_of(view)["reason"] == FAILED.reason)
    view.show(at_rest())
    wait_for(lambda: status_of(view)["word"] == "HOLDING")


@pytest.mark.parametrize("is_periodic", [True, False])
def test_an_old_state_at_rest_is_not_shown_if_further_ones_had_to_follow(view, is_periodic, monkeypatch):
    view.show(at_rest(is_periodic=is_periodic))
    wait_for(lambda: status_of(view)["reason"] not in ("", "The program starts."))
    assert status_of(view)["word"] == "HOLDING"
    now = time.monotonic() + 1.1 * STALE_AFTER_S
    monkeypatch.setattr(view._pages, "_clock", lambda: now)
    view._changed.set()  # a page that opens makes no state newer
    time.sleep(2.0 / view_module.FRAME_RATE_HZ)
    assert (status_of(view)["reason"] == STALE.reason) == is_periodic
