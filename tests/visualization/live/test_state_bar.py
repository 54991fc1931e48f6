"""The bar of the live page in a browser: words, emergency stop, lost connection, no WebGL, many and slow viewers."""

import time
from importlib.metadata import version
from pathlib import Path

import msgspec
from websockets.sync.client import connect

from dualbrain.records import Episode
from dualbrain.robots.loader import load_robot
from dualbrain.visualization.live.operator.operator_status import RESET_STEPS, Situation, describe_situation
from dualbrain.visualization.live.operator_buttons import OperatorAccess
from dualbrain.visualization.live.view import LiveView
from dualbrain.visualization.live.view_state import ViewState
from tests.visualization.conftest import scene
from tests.visualization.headless_browser import Browser

BAR = """
const text = id => document.getElementById(id)?.textContent;
const bar = document.getElementById('db-bar');
return bar && bar.className == '{}' && {{
  word: text('db-state'), reason: text('db-reason'), steps: bar.querySelectorAll('#db-steps li').length,
  stop: !!document.getElementById('db-stop'),
  foreign: performance.getEntriesByType('resource').map(one => one.name).filter(
    name => ![location.origin, 'blob:', 'data:'].some(own => name.startsWith(own))),
}};"""
ESCAPE = "document.body.dispatchEvent(new KeyboardEvent('keydown', {key: 'Escape', bubbles: true})); return true;"
TEXT_PAGE = """
const state = document.getElementById('state');
return state && {word: state.textContent, reason: document.getElementById('reason').textContent,
  stop: document.querySelector('a.stop')?.getAttribute('href')};"""
ESTOP = Situation(action="ESTOP", check="estop")


def open_view(port: int, sent: list[str]) -> LiveView:
    """A view of a robot with few spheres; `sent` receives the operator actions."""
    robot_model = load_robot("panda")

    def operate(action, speed) -> str:
        sent.append(action)
        return ""

    few_spheres = msgspec.structs.replace(robot_model, spheres=robot_model.spheres[::12])
    return LiveView(few_spheres, port, access=OperatorAccess(operate, "the-code"))


def state_of(situation: Situation) -> ViewState:
    return ViewState(t=0.0, frames={}, scene=scene(), situation=situation)


def test_the_bar_shows_the_words_stops_the_robot_and_notices_a_lost_connection(tmp_path: Path) -> None:
    sent: list[str] = []
    view = open_view(18170, sent)
    with Browser(tmp_path / "profile", (700, 500)) as browser:
        try:
            view.show(state_of(Situation(phase="planning")))
            browser.open(view.url)
            shown = browser.wait_for(BAR.format("HOLDING"), 60.0)
            assert shown["word"] == "HOLDING"
            assert shown["stop"]
            assert shown["foreign"] == []
            browser.execute_script(ESCAPE)
            until = time.monotonic() + 20.0
            while not sent and time.monotonic() < until:
                time.sleep(0.05)
            assert sent == ["estop"]
            view.show(state_of(ESTOP))
            shown = browser.wait_for(BAR.format("EMERGENCY_STOP"), 60.0)
            assert shown["steps"] == len(RESET_STEPS)
            assert shown["reason"] == describe_situation(ESTOP).reason
        finally:
            view.close()
        assert browser.wait_for(BAR.format("NO_CONNECTION"), 60.0)["word"] == "NO CONNECTION"


def test_a_browser_without_webgl_shows_the_words_as_text(tmp_path: Path, episode: Episode) -> None:
    sent: list[str] = []
    view = open_view(18180, sent)
    (tmp_path / "episode.json").write_bytes(msgspec.json.encode(episode))
    try:
        view.finish(episode, timeout=20.0)
        with Browser(tmp_path / "profile", (500, 400), "--disable-3d-apis") as browser:
            browser.open(view.url)
            shown = browser.wait_for(TEXT_PAGE, 60.0)
            exact = browser.execute_script("return document.getElementById('final-h_min').dataset.value")
            browser.execute_script("document.querySelector('a.stop').click(); return true;")
            until = time.monotonic() + 20.0
            while not sent and time.monotonic() < until:
                time.sleep(0.05)
    finally:
        view.close()
    on_disk = msgspec.json.decode((tmp_path / "episode.json").read_bytes(), type=Episode)
    assert (shown["word"], shown["stop"]) == ("STOPPED", "/estop")
    assert on_disk.outcome.reason[1:] in shown["reason"]
    assert float(exact) == on_disk.outcome.h_min
    assert sent == ["estop"]


def test_ten_viewers_that_read_nothing_delay_neither_a_state_nor_the_result(episode: Episode) -> None:
    view = open_view(18190, [])
    protocol = f"viser-v{version('viser')}"
    viewers = [
        connect(f"ws://127.0.0.1:{view.port}", subprotocols=[protocol], max_queue=1, max_size=None)  # type: ignore[list-item]
        for _ in range(10)
    ]
    try:
        for k in range(200):
            view.show(state_of(Situation(t=0.01 * k, in_contract=True, phase="carry")))
        start = time.monotonic()
        view.finish(episode, timeout=20.0)
        assert time.monotonic() - start < 20.0
        viewers.pop().close_socket()  # a tab that disappears
        view.show(state_of(ESTOP))
    finally:
        view.close()
        for viewer in viewers:
            viewer.close_socket()
