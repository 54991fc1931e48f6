"""Draw the images of the README: docs/images/demo.gif and docs/images/demo.png.

`MUJOCO_GL=egl python scripts/draw_demo.py docs/images` runs one given contract in scene 8, where a person's forearm
crosses the path of the arm. The animation runs at twice the real speed; the still image shows the moment in which the
forearm is nearest to the loaded hand.
"""

from __future__ import annotations

import os
import sys
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from dualbrain.contracts.verdict import Accepted
from dualbrain.control.control_loop import LoopObserver, TickSnapshot
from dualbrain.robots.loader import load_robot
from dualbrain.runtime.assembly import CellOptions, SimulatedCell, open_world
from dualbrain.simulation.perception.rendering import Camera
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene

SCENE = "8"
GRASP = {
    "object": "red_cube",
    "speed": 0.29,
    "clearance": 0.25,
    "finger_axis": "along",
    "opening": 0.06,
    "approach": "tilted",
    "wait": "until_clear",
    "force": 50,
}
PLACE = {"destination": "blue_bowl", "speed": 0.2, "clearance": 0.1, "route": "direct", "wait": "until_clear"}
"""The contract that `starter-135m` proposes for "put the red cube in the bowl" in this scene."""
SIZE, CROP = (1280, 960), (60, 56, 1220, 836)
FRAME_SIZE, FRAME_PERIOD_S, SPEED_UP = (580, 390), 0.2, 2.0
"""Size of a frame [pixels], simulated time between two frames [s], speed of the animation."""
CAPTION_HEIGHT, COLOURS = 30, 192
"""Height of the caption [pixels], number of colours of the palette."""


class Film:
    """Frames of a run with a caption of phase and filter, and the image in which the forearm is nearest to the load."""

    def __init__(self, plant: Plant, camera: Camera) -> None:
        """Take images of `plant` with `camera`."""
        self._plant, self._camera = plant, camera
        self._next_frame, self._nearest, self._delta = 0.0, np.inf, 0.0
        self.frames: list[Image.Image] = []
        self.still: Image.Image | None = None

    def on_tick(self, snapshot: TickSnapshot) -> None:
        """Take a frame every `FRAME_PERIOD_S`, and the still image when the forearm is nearest."""
        loaded = snapshot.nominal.holding is not None and snapshot.nominal.phase not in ("lift", "lower")
        distance = self._forearm_distance() if loaded else np.inf
        self._delta = max(self._delta, snapshot.result.delta)
        due = snapshot.state.stamp >= self._next_frame
        if not due and distance >= self._nearest - 0.01:
            return
        image = Image.fromarray(self._camera.capture()).crop(CROP)
        if distance < self._nearest - 0.01:
            self._nearest, self.still = distance, image
        if due:
            self._next_frame += FRAME_PERIOD_S
            small = image.resize(FRAME_SIZE, Image.Resampling.LANCZOS)
            self.frames.append(_with_caption(small, snapshot, self._delta))
            self._delta = 0.0

    def _forearm_distance(self) -> float:
        tool, _ = self._plant.tool_pose()
        return float(np.linalg.norm(np.array(self._plant.true_pose("forearm").position) - tool))


def _with_caption(image: Image.Image, snapshot: TickSnapshot, delta: float) -> Image.Image:
    """The image above a line with phase, largest intervention since the last frame, and clearance."""
    width, active = image.width, delta > 1e-3
    framed = Image.new("RGB", (width, image.height + CAPTION_HEIGHT), "white")
    framed.paste(image)
    draw = ImageDraw.Draw(framed)
    y, font = image.height + 7, ImageFont.load_default(13)
    share = min(1.0, delta * 4.0)
    draw.rectangle((0, image.height, round(width * share), image.height + 3), fill=(214, 92, 32))
    filtered = f"filter changes the command by {delta:.1%}" if active else "filter: no change"
    draw.text((8, y), f"{snapshot.skill}: {snapshot.nominal.phase}", fill="black", font=font)
    draw.text((width * 0.34, y), filtered, fill=(170, 60, 10) if active else (70, 110, 70), font=font)
    draw.text((width - 128, y), f"clearance {snapshot.result.h_min * 1000:4.0f} mm", fill="black", font=font)
    return framed


def _palette(frames: list[Image.Image]) -> Image.Image:
    """A palette for all frames, from a column of every tenth one."""
    sample = frames[::10]
    column = Image.new("RGB", (sample[0].width, sum(frame.height for frame in sample)))
    for i, frame in enumerate(sample):
        column.paste(frame, (0, i * frame.height))
    return column.quantize(COLOURS)


def main(folder: Path) -> None:
    """Run the contract and write both images."""
    robot = load_robot("panda")
    world = open_world(open_scene(SCENE), robot, CellOptions(visuals=True))
    with Camera(world.plant, width=SIZE[0], height=SIZE[1], shadows=True) as camera:
        film = Film(world.plant, camera)
        with SimulatedCell(robot, world, observer=LoopObserver(on_tick=film.on_tick)) as cell:
            actions = [{"skill": "grasp", "params": GRASP}, {"skill": "place", "params": PLACE}]
            verdict = cell.check(cell.contract(actions))
            if not isinstance(verdict, Accepted):
                sys.exit(f"The gate rejected the contract: {verdict}")
            outcome = cell.execute(verdict.contract)
            print(f"{outcome.kind}: {outcome.reason}; success on ground truth: {cell.judgement().success}")
    assert film.still is not None, "the arm carried the cube"
    film.still.save(folder / "demo.png", optimize=True)
    palette = _palette(film.frames)
    frames = [frame.quantize(palette=palette, dither=Image.Dither.NONE) for frame in film.frames]
    frames[0].save(
        folder / "demo.gif",
        save_all=True,
        append_images=frames[1:],
        duration=round(1000 * FRAME_PERIOD_S / SPEED_UP),
        loop=0,
        optimize=True,
    )
    print(f"{len(frames)} frames, {(folder / 'demo.gif').stat().st_size / 1e6:.1f} MB")


if __name__ == "__main__":
    main(Path(sys.argv[1]))
