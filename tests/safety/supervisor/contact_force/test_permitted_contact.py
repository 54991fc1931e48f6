"""Closed loop: a permitted contact presses with a bounded force, because its speed falls with the measured force."""

import msgspec
import numpy as np
import pytest

from dualbrain.control.control_loop import ControlLoop
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.core.geometry.shapes import Box
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.contact_force.limits import ContactForceLimits
from dualbrain.simulation.perception.noisy_perception import NO_NOISE, NoisyPerception
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.scenes.scene_spec import ObjectSpec
from dualbrain.simulation.world import SimulatedWorld
from dualbrain.skills.skill import Nominal, PermittedContact
from tests.safety.supervisor.contact_force.hidden_obstacle import HIDDEN, wall_force

PERMITTED = ContactForceLimits().permitted.value
YIELD_TIME = 0.03
"""Declared time for which a permitted contact may be above its permitted force [s]."""
GAP = 0.01
"""Distance of the fingers from the block at the start [m]."""


class PressingCell:
    """A hand that moves down onto a perceived block with a contact permit."""

    def __init__(self, *, supervised=True):
        robot_model = load_robot("panda")
        if not supervised:
            robot_model = msgspec.structs.replace(robot_model, force_sensing=None)
        self.safety = SafetyFilter(robot_model)
        home = np.array(robot_model.home)
        x, y, _ = self.safety.tool(home).position.tolist()
        centres, radii, groups = self.safety.spheres(home, 0.0)
        lowest = min(c[2] - r for c, r, group in zip(centres, radii, groups, strict=True) if group == "fingers")
        half = 0.5 * (lowest - GAP)
        block = ObjectSpec(
            name=HIDDEN,
            role="support",
            shape=Box((0.05, 0.05, half)),
            position=(x, y, half),
            mass=1.0,
            colour="oak",
            category="block",
            fixed=True,
        )
        bare = make_scene("bare", 0, "panda")
        seen = msgspec.structs.replace(bare, objects=(*bare.objects, block))
        self.plant = Plant(seen, robot_model)
        self.trace = Trace(robot_model.n)
        world = SimulatedWorld(self.plant, NoisyPerception(seen, NO_NOISE, np.random.default_rng(0)))
        self.loop = ControlLoop(robot_model, self.plant, world, self.safety, FlightLog(self.trace))

    def press(self, seconds, speed=0.05):
        """Forces [N] on the block while the hand is commanded to move down at `speed` [m/s]."""
        contacts = tuple(PermittedContact(part, HIDDEN, 0.05) for part in ("fingers", "hand"))
        forces = []
        for _ in range(round(seconds / self.plant.robot_model.period)):
            tool = self.safety.tool(self.loop.state.q)
            down = np.linalg.pinv(tool.jacobian) @ np.array([0.0, 0.0, -speed, 0.0, 0.0, 0.0])
            self.loop.tick(Nominal(u=down, opening=0.0, force=5.0, phase="press", contacts=contacts), 0)
            forces.append(wall_force(self.plant))
        return np.array(forces)


def checks(cell):
    return [event.data["check"] for event in cell.trace.events if "check" in event.data]


def longest_time_above(forces, limit):
    """Longest time for which the force stays above `limit` [s]."""
    above = np.concatenate([[0], (forces > limit).astype(int), [0]])
    edges = np.flatnonzero(np.diff(above))
    return 1e-3 * max(np.diff(edges)[::2], default=0)


def test_a_permitted_contact_yields_above_the_permitted_force():
    cell = PressingCell()
    forces = cell.press(1.5)
    assert longest_time_above(forces, PERMITTED) <= YIELD_TIME
    assert "unexpected_contact" not in checks(cell)
    first = int(np.flatnonzero(forces)[0])
    assert forces[first + 100 :].max() < 0.75 * forces.max(), "the hand comes back slower than it hit"


def test_without_force_sensing_it_presses_on():
    forces = PressingCell(supervised=False).press(0.6)
    assert longest_time_above(forces, PERMITTED) > 5.0 * YIELD_TIME


def test_the_speed_of_the_permit_is_restored_after_the_contact():
    cell = PressingCell()
    cell.press(0.6)
    assert cell.loop.safety_controller.contact.permitted_speed.scale < 1.0
    cell.press(3.0, speed=-0.02)
    assert cell.loop.safety_controller.contact.permitted_speed.scale == pytest.approx(1.0)
