"""The live page in a browser shows the same numbers as the stored episode."""

from pathlib import Path

import msgspec

from dualbrain.control.recording.trace import Trace
from dualbrain.records import Episode
from dualbrain.robots.loader import load_robot
from dualbrain.visualization.html.key_numbers import key_numbers
from dualbrain.visualization.live.view import LiveView
from tests.visualization.conftest import scene
from tests.visualization.headless_browser import Browser
from tests.visualization.sample_view_states import view_state_at

# A script on a page that is rendered in software takes a second, so one script reads everything.
LIVE = """
const phase = document.getElementById('live-phase');
return phase && {
  phase: phase.textContent, h_min: document.getElementById('live-h_min').textContent,
  text: document.body.textContent, markup: document.querySelectorAll('li b').length,
}"""
FINAL = """
const bar = document.getElementById('db-bar');
if (!document.getElementById('final-outcome') || bar.className != 'STOPPED') return null;
const cells = [...document.querySelectorAll('[id^=final-]')];
return {
  cells: Object.fromEntries(cells.map(cell => [cell.id, [cell.textContent, cell.dataset.value]])),
  bar: document.getElementById('db-reason').textContent,
  sources: performance.getEntriesByType('resource').map(entry => entry.name),
}"""


def test_the_page_shows_the_run_and_its_result(tmp_path: Path, trace: Trace, episode: Episode) -> None:
    (tmp_path / "episode.json").write_bytes(msgspec.json.encode(episode))
    robot_model = load_robot("panda")
    robot_model = msgspec.structs.replace(robot_model, spheres=robot_model.spheres[::12])
    view = LiveView(robot_model, 18100, instruction=episode.instruction)
    try:
        with Browser(tmp_path / "profile", (700, 500)) as browser:
            browser.open(view.url)
            view.show(view_state_at(robot_model, trace, scene(), 10_600))
            live = browser.wait_for(LIVE, 90.0)
            view.finish(episode, timeout=20.0)
            final = browser.wait_for(FINAL, 90.0)
            console = browser.console_messages()
    finally:
        view.close()
    assert (live["phase"], live["h_min"]) == ("carry", f"{1e3 * trace['h_min'][10_600]:.2f}mm")
    assert "put the red cube in the bowl" in live["text"]
    assert "<b>wrist vs 'forearm'</b>" in live["text"]
    assert live["markup"] == 0
    assert "share" not in live["text"].lower()
    on_disk = msgspec.json.decode((tmp_path / "episode.json").read_bytes(), type=Episode)
    assert final["cells"]["final-outcome"] == [on_disk.outcome.kind, on_disk.outcome.kind]
    assert on_disk.outcome.reason[1:] in final["bar"]
    for one in key_numbers(on_disk):
        text, exact = final["cells"][f"final-{one.name}"]
        assert text == one.text + one.unit
        assert float(exact) == one.value
    assert [name for name in final["sources"] if not name.startswith((view.url, "blob:", "data:"))] == []
    assert [line for line in console if "Uncaught" in line or "rror:" in line] == []
