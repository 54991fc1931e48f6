"""Draw the images of the console in docs/images/console, in both colour schemes.

`python -m scripts.draw_console docs/images/console` carries out an instruction three times in the simulation (planner
`base-135m`), so that there are runs and memories with citations, shows them in the console with the scene and the
events of the last run, and takes images with headless Chromium.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import msgspec

from dualbrain.control.recording.channels import OWN_RECORDING_LIMITS, read_trace
from dualbrain.grounding.vocabulary import scene_names
from dualbrain.records import Episode
from scripts.draw_live_view import save_image
from tests.agent_server.console.console_server import ConsoleServer, serve_console
from tests.visualization.headless_browser import Browser

SIZE = (1360, 940)
RUN = ("run", "put the red cube in the bowl", "--headless", "--planner", "base-135m", "--scene")
SCENES = ("0", "4", "8")
READY = "return document.querySelector('#verdict b') && document.querySelector('#events li') && true"
MISTAKE = """
const text = document.getElementById('text');
text.value = text.value.replace('"duration": 1', '"duration": 60');
text.dispatchEvent(new Event('input'));"""
STEPS = {
    "contract": MISTAKE,
    "memory": "document.getElementById('tab-memory').click()",
    "runs": "document.getElementById('tab-runs').click()",
    "report": "document.querySelector('#runs-table td button').click()",
    "emergency_stop": "document.getElementById('estop').click()",
}
"""Name of each image, and the script that leads to it from the one before."""
SETTLING_TIME_S = 1.5


def main(folder: Path) -> None:
    """Write all images."""
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory() as home:
        runs = [Path(home) / "runs" / f"run-{number}" for number in range(1, len(SCENES) + 1)]
        for run, scene in zip(runs, SCENES, strict=True):
            command = [sys.executable, "-m", "dualbrain", *RUN, scene, "--out", str(run)]
            subprocess.run(command, check=False, env=os.environ | {"DUALBRAIN_HOME": home})
        with serve_console(Path(home)) as console:
            show_run(console, runs[-1])
            for scheme in ("light", "dark"):
                console.robot.reset()
                draw(folder, scheme, console, Path(home) / scheme)


def show_run(console: ConsoleServer, run: Path) -> None:
    """Give the robot of the console the scene and the events of `run`."""
    episode = msgspec.json.decode((run / "episode.json").read_bytes(), type=Episode)
    console.robot.summary, console.robot.names = episode.summary, scene_names(episode.scene)
    trace = read_trace(run / "episode.mcap", OWN_RECORDING_LIMITS)
    for event in trace.events if trace else ():
        console.robot.feed.add(event.t, event.kind, event.text)


def draw(folder: Path, scheme: str, console: ConsoleServer, profile: Path) -> None:
    """Write the images of one colour scheme."""
    media = {"features": [{"name": "prefers-color-scheme", "value": scheme}]}
    with Browser(profile, SIZE) as browser:
        browser.send("/goog/cdp/execute", {"cmd": "Emulation.setEmulatedMedia", "params": media})
        browser.open(console.page)
        browser.wait_for(READY)
        for name, script in STEPS.items():
            browser.execute_script(script)
            time.sleep(SETTLING_TIME_S)
            save_image(browser, folder / f"{name}_{scheme}.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
