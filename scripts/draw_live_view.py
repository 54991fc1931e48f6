"""Draw the images of the live view in docs/images/live: every state of the operator's bar in both colour schemes.

`MUJOCO_GL=egl python -m scripts.draw_live_view docs/images/live` runs the motion of `filter_demo.py`, shows selected
moments in the live view, and takes images with headless Chromium. The states of the supervisor are those of its table;
the robot is at rest in them.
"""

from __future__ import annotations

import base64
import io
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from threading import Event, Thread

import numpy as np
from PIL import Image

from dualbrain.contracts.contract import Action
from dualbrain.simulation.plant.render_meshes import link_meshes, object_meshes
from dualbrain.simulation.world import SimulatedWorld
from dualbrain.visualization.live.operator_buttons import OperatorAccess
from dualbrain.visualization.live.state_builder import StateBuilder, tick_of_result
from dualbrain.visualization.live.view import LiveView
from dualbrain.visualization.live.view_state import ViewState
from scripts.filter_demo import ROBOT, DemoTick, open_demo_world, run_demo
from tests.visualization.headless_browser import Browser

SIZE = (1280, 940)
PORT = 18980
INSTRUCTION = "put the red cube in the bowl"
PLAN = (
    Action("grasp", {"object": "red_cube"}),
    Action("place", {"destination": "blue_bowl"}),
)
HELD_STATES = {
    "holding": ("HOVER", "paused", "SAFE"),
    "stopped": ("CONTROLLED_STOP", "unexpected_contact", "SAFE"),
    "emergency_stop": ("ESTOP", "estop", "SAFE"),
}
"""Name of a image, and action, check and filter status in it."""
LOADED = "return document.getElementById('plain-step') && document.getElementById('db-state') ? true : null;"
DISMISS = "document.querySelectorAll('.mantine-Notification-closeButton').forEach(one => one.click());"
"""Closes the notice of viser about a browser without a graphics card."""
SHOWN = "return document.getElementById('db-bar').className == '{}' || null;"
SETTLING_TIME_S = 6.0
"""Time [s] for a frame in a browser without a graphics card."""
COLOURS = 256


def states_of(world: SimulatedWorld) -> dict[str, ViewState]:
    """The view state of each image."""
    builder = StateBuilder(ROBOT)
    ticks: list[DemoTick] = []
    frames = []
    for demo in run_demo(world, guard=True):
        if len(ticks) == len(frames) and demo.state.sequence % 20 == 0:
            ticks.append(demo)
            frames.append(world.plant.link_poses())
    builder.set_plan(PLAN, ticks[0].scene, ticks[0].state.q)
    builder.begin_step(0)
    free = next(k for k, one in enumerate(ticks) if one.state.stamp > 3.0)
    strongest = int(np.argmax([one.result.delta for one in ticks]))
    found = {
        "moving": _state(builder, ticks[free], frames[free]),
        "giving_way": _state(builder, ticks[strongest], frames[strongest]),
    }
    for name, (action, check, status) in HELD_STATES.items():
        situation = replace(found["moving"].situation, action=action, check=check, filter_status=status)
        still = (0.0, 0.0, 0.0)
        found[name] = replace(
            found["moving"], situation=situation, nominal_velocity=still, filtered_velocity=still, ghost={}
        )
    return found


def _state(builder: StateBuilder, demo: DemoTick, frames) -> ViewState:
    tick = tick_of_result(
        demo.state, demo.scene, demo.result, in_contract=True, skill="grasp", phase="approach", action="NONE", check=""
    )
    builder.count(tick.delta)
    return builder.build(tick, frames, (f"{tick.t:.1f} s  grasp: approach",))


class Repeater:
    """Shows the same state again and again, because the page does not trust an old one."""

    def __init__(self, view: LiveView, state: ViewState) -> None:
        """Start with `state`."""
        self.state, self._view, self._ended = state, view, Event()
        self._start = time.monotonic()
        self._thread = Thread(target=self._repeat, daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stop."""
        self._ended.set()
        self._thread.join()

    def _repeat(self) -> None:
        while not self._ended.wait(0.5):
            self._view.show(replace(self.state, t=time.monotonic() - self._start))


def save_image(browser: Browser, path: Path) -> None:
    """Save the window of the browser as a small PNG file."""
    shot = Image.open(io.BytesIO(base64.b64decode(browser.screenshot()))).convert("RGB")
    shot.quantize(COLOURS, Image.Quantize.FASTOCTREE, dither=Image.Dither.NONE).save(path, optimize=True)
    print(path, f"{path.stat().st_size / 1e3:.0f} kB")


def main(folder: Path) -> None:
    """Write all images."""
    folder.mkdir(parents=True, exist_ok=True)
    world = open_demo_world()
    states = states_of(world)
    view = LiveView(
        ROBOT,
        PORT,
        instruction=INSTRUCTION,
        access=OperatorAccess(lambda action, speed: "", "code"),
        link_meshes=link_meshes(world.plant),
        object_meshes=object_meshes(world.plant),
        submit=lambda instruction: "",
    )
    shown = Repeater(view, states["moving"])
    with tempfile.TemporaryDirectory() as profile, Browser(Path(profile), SIZE) as browser:
        for scheme, query in (("light", ""), ("dark", "?darkMode")):
            shown.state = states["moving"]
            browser.open(f"{view.url}/{query}")
            browser.wait_for(LOADED, 90.0)
            browser.execute_script(DISMISS)
            for name, state in states.items():
                shown.state = state
                browser.wait_for(SHOWN.format(name.upper()), 60.0)
                time.sleep(SETTLING_TIME_S)
                save_image(browser, folder / f"{name}_{scheme}.png")
        shown.close()
        view.close()
        browser.wait_for(SHOWN.format("NO_CONNECTION"), 60.0)
        save_image(browser, folder / "no_connection_dark.png")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
