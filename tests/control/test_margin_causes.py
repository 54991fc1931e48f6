"""Every fall of h below 0 has a cause, which is the change that explains it."""

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from dualbrain.control.margin_causes import MarginMonitor
from dualbrain.core.geometry.shapes import Pose, Sphere
from dualbrain.records import MARGIN_CAUSE_TEXTS, MarginCause
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Contact, Obstacle

MODEL = load_robot("panda")
RADIUS, MARGIN = 0.02, 0.009


class Bench:
    """A filter and its monitor, and obstacles placed at a given h from a part of the robot at home."""

    def __init__(self):
        self.safety = SafetyFilter(MODEL)
        self.monitor = MarginMonitor(self.safety)
        self.state, self.ticks = home_state(MODEL), 0

    @property
    def now(self):
        return self.ticks * MODEL.period

    def obstacle(self, h, part="hand", direction=(1.0, 0.0, 0.0), **fields):
        """A sphere in `direction` of the outermost sphere of `part`, at h [m] from it and further from all others."""
        centres, radii, groups = self.safety.spheres(self.state.q, self.state.opening)
        way = np.array(direction) / np.linalg.norm(direction)
        chosen = [i for i, group in enumerate(groups) if group == part]
        i = max(chosen, key=lambda k: centres[k] @ way + radii[k])
        position = centres[i] + way * (radii[i] + RADIUS + MARGIN + h)
        return Obstacle(name="cup", shape=Sphere(RADIUS), pose=Pose(tuple(position.tolist())), margin=MARGIN, **fields)

    def tick(self, u=None, supervised=0.0, **changes):
        self.ticks += 1
        self.state = replace(self.state, stamp=self.now, sequence=self.ticks, **changes)
        result = self.safety.filter(self.state, np.zeros(MODEL.n) if u is None else u, self.now)
        if supervised:
            result = msgspec.structs.replace(result, delta_supervisor=supervised)
        return self.monitor.update(self.now, self.state, result)


@pytest.fixture
def bench():
    return Bench()


def cause_of(shortfall):
    assert shortfall is not None
    assert shortfall.h_min < 0.0
    return shortfall.cause


def test_the_first_tick(bench):
    bench.safety.observe([bench.obstacle(-0.002)])
    assert cause_of(bench.tick()) is MarginCause.START


def test_an_observation_that_moves_the_obstacle(bench):
    bench.safety.observe([bench.obstacle(0.001)])
    assert bench.tick() is None
    bench.safety.observe([bench.obstacle(-0.002)])
    found = bench.tick()
    assert cause_of(found) is MarginCause.PERCEPTION_JUMP
    assert found.pair == "hand vs 'cup'"
    assert found.change == pytest.approx(0.003, abs=1e-4)


def test_an_observation_that_enlarges_the_margin(bench):
    bench.safety.observe([bench.obstacle(0.001)])
    bench.tick()
    bench.safety.observe([msgspec.structs.replace(bench.obstacle(0.001), margin=MARGIN + 0.003)])
    assert cause_of(bench.tick()) is MarginCause.PERCEPTION_JUMP


def test_an_obstacle_that_appears(bench):
    bench.tick()
    bench.safety.observe([bench.obstacle(-0.002)])
    assert cause_of(bench.tick()) is MarginCause.PERCEPTION_JUMP


def test_a_person_who_accelerates(bench):
    bench.safety.observe([bench.obstacle(0.02, velocity_error=0.02)], 0.0)
    bench.tick()
    bench.safety.observe([bench.obstacle(-0.002, velocity=(-0.5, 0.0, 0.0), velocity_error=0.02)], 0.001)
    assert cause_of(bench.tick()) is MarginCause.PERSON_ACCELERATION


def test_a_velocity_within_its_error_is_no_acceleration(bench):
    bench.safety.observe([bench.obstacle(0.001, velocity_error=0.02)], 0.0)
    bench.tick()
    bench.safety.observe([bench.obstacle(-0.002, velocity=(-0.03, 0.0, 0.0), velocity_error=0.02)], 0.001)
    assert cause_of(bench.tick()) is MarginCause.PERCEPTION_JUMP


def test_a_permit_that_ends(bench):
    bench.safety.observe([bench.obstacle(-0.002)])
    bench.safety.permit([Contact(part, "cup", 0.05) for part in ("hand", "fingers", "arm")])
    assert bench.tick() is None
    bench.safety.permit([])
    assert cause_of(bench.tick()) is MarginCause.PERMIT_END


def test_a_permitted_contact_is_no_shortfall_and_the_pair_is_the_one_without_a_permit(bench):
    far = msgspec.structs.replace(bench.obstacle(-0.001, direction=(0.0, 0.0, -1.0), part="fingers"), name="cube")
    bench.safety.observe([bench.obstacle(0.001), far])
    bench.safety.permit([Contact("fingers", "cube", 0.05), Contact("hand", "cube", 0.05)])
    assert bench.tick() is None
    bench.safety.observe([bench.obstacle(-0.0005), far])
    found = bench.tick()
    assert found.pair == "hand vs 'cup'"


def test_a_grasped_object(bench):
    bench.safety.observe([bench.obstacle(0.001)])
    bench.tick()
    cup = np.array(bench.obstacle(0.0).pose.position)
    tool = bench.safety.tool(bench.state.q)
    centre = tool.rotation.T @ (cup - tool.position)
    bench.safety.attach([[*centre, 0.01]], 0.0)
    assert cause_of(bench.tick()) is MarginCause.ATTACH_DETACH


def test_a_released_object_that_is_an_obstacle_again(bench):
    bench.safety.attach([[0.0, 0.0, 0.05, 0.01]], 0.0)
    bench.tick()
    bench.safety.detach()
    bench.safety.observe([bench.obstacle(-0.002)])
    assert cause_of(bench.tick()) is MarginCause.ATTACH_DETACH


def test_fingers_that_open(bench):
    bench.state = replace(bench.state, opening=0.01)
    rotation = bench.safety.tool(bench.state.q).rotation
    bench.safety.observe([bench.obstacle(0.001, part="fingers", direction=rotation[:, 1] + 2.0 * rotation[:, 2])])
    assert bench.tick() is None
    assert cause_of(bench.tick(opening=0.015)) is MarginCause.GRIPPER


def test_no_safe_control(bench):
    bench.safety.observe([bench.obstacle(0.006, velocity=(-2.0, 0.0, 0.0))], 0.0)
    shortfall = next(found for found in (bench.tick() for _ in range(20)) if found)
    assert cause_of(shortfall) is MarginCause.INFEASIBILITY


def test_no_safe_control_after_an_acceleration_is_the_persons(bench):
    bench.safety.observe([bench.obstacle(0.005, velocity_error=0.02)], 0.0)
    bench.tick()
    bench.safety.observe([bench.obstacle(0.004, velocity=(-2.0, 0.0, 0.0), velocity_error=0.02)], 0.001)
    shortfall = next(found for found in (bench.tick() for _ in range(20)) if found)
    assert cause_of(shortfall) is MarginCause.PERSON_ACCELERATION


def test_a_state_that_the_control_does_not_explain(bench):
    bench.safety.observe([bench.obstacle(0.001)])
    bench.tick()
    nearer = bench.safety.tool(bench.state.q).jacobian[0]
    assert cause_of(bench.tick(q=bench.state.q + 0.01 * nearer / np.linalg.norm(nearer))) is MarginCause.TRACKING


def test_a_control_of_the_supervisor(bench):
    bench.safety.observe([bench.obstacle(0.001)])
    bench.tick(supervised=0.3)
    nearer = bench.safety.tool(bench.state.q).jacobian[0]
    assert cause_of(bench.tick(q=bench.state.q + 0.01 * nearer / np.linalg.norm(nearer))) is MarginCause.SUPERVISOR


def test_an_interval_has_its_duration_and_least_value_and_ends(bench):
    bench.safety.observe([bench.obstacle(0.001)])
    bench.tick()
    bench.safety.observe([bench.obstacle(-0.001)])
    bench.tick()
    bench.safety.observe([bench.obstacle(-0.002)])
    bench.tick()
    bench.safety.observe([bench.obstacle(0.001)])
    assert bench.tick() is None
    (found,) = bench.monitor.shortfalls
    assert found.duration == pytest.approx(2 * MODEL.period)
    assert found.h_min == pytest.approx(-0.002, abs=5e-5)
    assert bench.monitor.between(0.0, found.start - 1e-6) == ()
    assert bench.monitor.between(found.start, 1.0) == (found,)
    bench.monitor.clear()
    assert bench.monitor.shortfalls == ()


def test_every_cause_has_words_and_a_shortfall_explains_itself(bench):
    assert set(MARGIN_CAUSE_TEXTS) == set(MarginCause)
    bench.safety.observe([bench.obstacle(-0.002)])
    bench.tick()
    found = msgspec.structs.replace(bench.monitor.shortfalls[0], h_min=-0.002)
    assert found.explain() == (
        "the margin of hand vs 'cup' was short by up to 2.00 mm for 1 ms: it was short in the first tick"
    )
