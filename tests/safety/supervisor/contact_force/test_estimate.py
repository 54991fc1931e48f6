"""Laws of the estimate: zero without contact, a known force within its uncertainty, a load that is no contact."""

import msgspec
import mujoco
import numpy as np
import pytest

from dualbrain.robots.interface import Command
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import ForceSensing
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.contact_force.estimate import DAMPING, LEAST_JOINTS, ForceSolver
from dualbrain.safety.contact_force.limits import ContactForceLimits
from dualbrain.safety.contact_force.monitor import ContactForceMonitor
from dualbrain.safety.contact_force.permitted_speed import PermittedSpeed, speed_scale
from dualbrain.safety.contact_force.retreat import SPEED, Retreat
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.tabletop import make_scene

LIMITS = ContactForceLimits()
WRIST = ForceSensing(
    kind="wrist_wrench", noise=(0.5,) * 3 + (0.01,) * 3, accuracy=(1.0,) * 3 + (0.05,) * 3, provenance=""
)
TOO_NOISY = 1.5
"""Model and sensor errors in motion, relative to the declared error at rest."""


class PushedArm:
    """A simulated arm that moves in sines while a force pushes one of its bodies."""

    def __init__(self, robot, *, sensing=None, load=0.0, amplitude=0.3):
        self.robot_model = load_robot(robot)
        if sensing:
            self.robot_model = msgspec.structs.replace(self.robot_model, force_sensing=sensing)
        self.plant = Plant(make_scene("bare", 0, robot), self.robot_model, load=load)
        self.plant.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self.monitor = ContactForceMonitor(SafetyFilter(self.robot_model))
        self.amplitude = amplitude
        self.magnitudes = []

    def run(self, seconds, *, force=(0.0, 0.0, 0.0), body="hand", point=None):
        n = self.robot_model.n
        for _ in range(round(seconds / self.robot_model.period)):
            u = self.amplitude * np.sin(2.0 * self.plant.now + np.arange(n))
            self.plant.write(Command(u, 0.04, 5.0))
            self._push(force, body, point)
            self.plant.advance()
            self.monitor.update(self.plant.read())
            if self.monitor.force is not None:
                self.magnitudes.append(self.monitor.force.magnitude)
        return self.monitor.force

    def _push(self, force, body, point):
        data, number = self.plant.data, int(self.plant.model.body(f"robot/{body}").id)
        at = self.plant.tool_pose()[0] if point == "tool" else data.xpos[number]
        data.xfrc_applied[:] = 0.0
        data.xfrc_applied[number, :3] = force
        data.xfrc_applied[number, 3:] = np.cross(at - data.xipos[number], force)


@pytest.mark.parametrize(("robot", "sensing"), [("panda", None), ("ur5e", None), ("panda", WRIST)])
def test_an_arm_that_touches_nothing_feels_nothing(robot, sensing):
    arm = PushedArm(robot, sensing=sensing)
    arm.run(2.0)
    assert max(arm.magnitudes) < min(TOO_NOISY * arm.monitor.force.uncertainty, 0.5 * LIMITS.unexpected.value)


@pytest.mark.parametrize(("robot", "sensing"), [("panda", None), ("ur5e", None), ("panda", WRIST)])
@pytest.mark.parametrize("force", [(25.0, 0.0, 0.0), (0.0, -25.0, 0.0), (0.0, 0.0, 25.0), (10.0, 10.0, -10.0)])
def test_a_force_at_the_tool_is_recovered_within_its_uncertainty(robot, sensing, force):
    arm = PushedArm(robot, sensing=sensing, amplitude=0.1)
    arm.run(0.1)
    found = arm.run(0.5, force=force, point="tool")
    assert np.linalg.norm(np.array(found.vector) - force) < found.uncertainty + 0.05 * np.linalg.norm(force)
    assert found.place == "tool"


def test_a_force_at_the_elbow_is_found_at_a_link_before_the_hand_and_not_overestimated():
    arm = PushedArm("panda", amplitude=0.1)
    arm.run(0.1)
    found = arm.run(0.5, force=(0.0, 80.0, 0.0), body="link4")
    assert found.place in {"link3", "link4"}
    assert LIMITS.unexpected.value < found.magnitude < 80.0 + found.uncertainty


def test_a_force_that_begins_is_reported_within_ten_milliseconds():
    arm = PushedArm("panda", amplitude=0.1)
    arm.run(0.1)
    assert not arm.monitor.is_exceeded
    arm.run(0.010, force=(0.0, 35.0, 0.0), point="tool")
    assert arm.monitor.is_exceeded


def test_a_load_is_weight_after_a_grasp_and_a_force_without_one():
    arm = PushedArm("panda", load=0.5, amplitude=0.2)
    assert arm.run(1.0).magnitude == pytest.approx(0.5 * 9.81, abs=1.5)
    arm.monitor.set_holding(True, arm.plant.now)
    found = arm.run(1.5)
    assert found.load == pytest.approx(0.5, abs=0.1)
    assert found.magnitude < 2.0


def test_a_later_force_is_not_mistaken_for_weight():
    arm = PushedArm("panda", amplitude=0.1)
    arm.monitor.set_holding(True, arm.plant.now)
    arm.run(2.5)
    found = arm.run(1.0, force=(0.0, 0.0, -25.0), point="tool")
    assert found.load < 0.2
    assert found.felt_load == pytest.approx(25.0 / 9.81, abs=0.3)
    assert arm.monitor.is_exceeded


def test_without_a_reading_nothing_is_estimated():
    arm = PushedArm("panda")
    arm.run(0.1)
    arm.plant.stop()
    arm.plant.advance()
    assert not arm.monitor.update(arm.plant.read())
    assert arm.monitor.force is None


def test_the_permitted_speed_falls_to_zero_at_the_permitted_force():
    most = LIMITS.permitted.value
    assert speed_scale(0.0, LIMITS) == speed_scale(0.5 * most, LIMITS) == 1.0
    assert speed_scale(most, LIMITS) == speed_scale(2.0 * most, LIMITS) == 0.0
    scales = [speed_scale(force, LIMITS) for force in np.linspace(0.0, most, 50)]
    assert np.all(np.diff(scales) <= 0.0)


def test_the_permitted_speed_falls_and_rises_at_the_declared_rates():
    speed, period, permitted = 0.05, 0.004, PermittedSpeed(LIMITS)

    def scales(force, count):
        found = [permitted.scale]
        for _ in range(count):
            permitted.update(force, speed, period)
            found.append(permitted.scale)
        return np.diff(found)

    step = 1.0 / 16  # the scale changes in steps
    falling = scales(0.99 * LIMITS.permitted.value, 100)
    assert -falling.min() <= LIMITS.deceleration.value * period / speed + step
    assert permitted.scale < 0.1
    rising = scales(0.0, 400)
    assert rising.max() <= LIMITS.recovery.value * period / speed + step
    assert permitted.scale < 1.0
    scales(0.0, 400)
    assert permitted.scale == 1.0
    scales(2.0 * LIMITS.permitted.value, 1)
    assert permitted.scale == 0.0


def test_the_arm_may_press_harder_with_a_permit():
    monitor = ContactForceMonitor(SafetyFilter(load_robot("panda")))
    without = monitor.limit
    monitor.set_permits(0.05)
    assert without < LIMITS.permitted.value < monitor.limit


def test_the_retreat_moves_the_contact_along_the_force_and_follows_the_arm():
    arm = PushedArm("panda", amplitude=0.0)
    arm.run(0.1)
    found = arm.run(0.3, force=(0.0, 30.0, 0.0), point="tool")
    state, retreat = arm.plant.read(), Retreat(arm.monitor)
    jacobian = arm.monitor._safety.tool(state.q).jacobian[:3]
    along = np.array(found.vector) / found.magnitude
    assert along @ jacobian @ retreat.control(7) == pytest.approx(SPEED, rel=0.1)
    torque = arm.monitor.joint_torque
    pushing, yielding = -0.2 * np.sign(torque), 0.2 * np.sign(torque)
    assert np.array_equal(retreat.yielding_control(state, pushing), state.v)
    assert np.array_equal(retreat.yielding_control(state, yielding), yielding)


def test_the_place_of_a_contact_is_the_sphere_of_least_cost():
    robot_model = load_robot("panda")
    safety, solver = SafetyFilter(robot_model), ForceSolver(robot_model, 0)
    tool = safety.tool(robot_model.home)
    centres, _, _ = safety.spheres(robot_model.home, 0.04)
    links = [link for link in robot_model.links for sphere in robot_model.spheres if sphere.link == link.name]
    rng = np.random.default_rng(4)
    for _ in range(20):
        torque = rng.normal(0.0, 10.0, 7)
        costs = {}
        for link, centre in zip(links, centres, strict=True):
            if link.frame < LEAST_JOINTS:
                continue
            moved = np.arange(7) < link.frame
            J = (tool.jacobian[:3] + np.cross(tool.jacobian[3:].T, centre - tool.position).T) * moved
            stacked = np.vstack([J.T, DAMPING * np.eye(3)])
            force, *_ = np.linalg.lstsq(stacked, np.r_[torque, np.zeros(3)], rcond=None)
            cost = float(np.sum((torque - J.T @ force) ** 2) + DAMPING**2 * force @ force)
            costs[cost] = link.name, force
        found = solver.at_links(torque, tool.jacobian, tool.position, centres)
        place, force = costs[min(costs)]
        assert found.place == place
        np.testing.assert_allclose(found.vector, force, atol=1e-6 * np.linalg.norm(force))
