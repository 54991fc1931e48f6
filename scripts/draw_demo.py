"""Draws the picture of the README: `MUJOCO_GL=egl python docs/images/make_demo_picture.py docs/images/demo.png`.

A given contract runs in scene 0; the picture is taken while the arm carries the cube and the forearm is nearest.
"""

import os
import sys

os.environ.setdefault("MUJOCO_GL", "egl")

import numpy as np
from matplotlib import image

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.contract_executor import LocalLayer
from dualbrain.control.control_loop import LayerConfig, Moment
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.robots.loader import load_body
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.perception.noisy_perception import Noise, Perception
from dualbrain.simulation.perception.rendering import Camera
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.world import SimulatedWorld

GRASP = {
    "object": "red_cube", "speed": 0.25, "clearance": 0.12, "finger_axis": "along", "opening": 0.07,
    "approach": "top", "wait": "none", "force": 20.0,
}  # fmt: skip
PLACE = {"destination": "blue_bowl", "speed": 0.25, "clearance": 0.12, "route": "direct", "wait": "none"}
CONTRACT = Contract("c-0001", Context("panda", ""), (Action("grasp", GRASP), Action("place", PLACE)))
ROWS, COLUMNS = slice(56, 836), slice(60, 1220)
CLOSER = 0.01
"""A picture replaces the one before when the forearm has come nearer by this [m]."""


class Photographer:
    """Keeps the picture of the moment in which the forearm was nearest to the loaded hand."""

    def __init__(self, plant: Plant, camera: Camera) -> None:
        self._plant, self._camera, self._nearest = plant, camera, np.inf
        self.picture = None

    def moment(self, moment: Moment) -> None:
        """Look at a tick of the loop."""
        if moment.nominal.holding is None or moment.nominal.phase in ("lift", "lower"):
            return
        tool, _ = self._plant.tool_pose()
        distance = float(np.linalg.norm(np.array(self._plant.truth("forearm").position) - tool))
        if distance < self._nearest - CLOSER:
            self._nearest, self.picture = distance, self._camera.snap().copy()


def main(path: str) -> None:
    """Run, choose, crop, write."""
    body, spec = load_body("panda"), open_scene("0")
    plant = Plant(spec, body, visuals=True)
    world = SimulatedWorld(plant, Perception(spec, Noise(), np.random.default_rng(0)))
    with Camera(plant, width=1280, height=960, shadows=True) as camera:
        photographer = Photographer(plant, camera)
        log = FlightLog(Trace(body.n), announce=lambda event: sys.stderr.write(f"{event.t:6.2f} s  {event.text}\n"))
        layer = LocalLayer(
            body, plant, world, SafetyFilter(body), log, LayerConfig(),
            watch=photographer.moment, phase_changed=world.allow,
        )  # fmt: skip
        layer.run(CONTRACT)
    image.imsave(path, photographer.picture[ROWS, COLUMNS])


if __name__ == "__main__":
    main(sys.argv[1])
