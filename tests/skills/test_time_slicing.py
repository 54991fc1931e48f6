"""Thoughts: the clearest of many, and that no control tick thinks longer than its share."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.core.geometry.shapes import Box, HalfSpace, Pose
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.skills.arm.controller import ArmController
from dualbrain.skills.registry import SkillExecution, make_controller
from dualbrain.skills.skill import Nominal, Observation
from dualbrain.skills.time_slicing import (
    STEPS_PER_SECOND,
    SUFFICIENT_CLEARANCE,
    BackgroundComputation,
    first_clear,
    run_to_completion,
    steps_per_tick,
)

rooms_of = st.lists(st.floats(-0.1, 0.1), max_size=8)


def thought(answer, pauses=0):
    """A thought of so many pauses."""
    for _ in range(pauses):
        yield
    return answer


@given(rooms_of, st.floats(-0.05, 0.05))
def test_the_first_clear_choice_is_taken_else_the_roomiest(rooms, enough):
    asked = []

    def air(index, beat):
        asked.append(index)
        return thought(rooms[index] if rooms[index] > beat else beat - 0.001)

    choice, most = run_to_completion(first_clear(range(len(rooms)), air))
    clear = [index for index, one in enumerate(rooms) if one >= SUFFICIENT_CLEARANCE]
    if clear:
        assert choice == clear[0]
        assert asked == list(range(clear[0] + 1))
    elif rooms:
        assert rooms[choice] == most == max(rooms)
    else:
        assert choice is None
    taken, _ = run_to_completion(
        first_clear(range(len(rooms)), air, threshold=min(enough, SUFFICIENT_CLEARANCE - 1e-6))
    )
    assert (taken is None) == (not rooms or max(rooms) <= min(enough, SUFFICIENT_CLEARANCE - 1e-6))


@given(st.integers(0, 20), st.integers(1, 6))
def test_a_thought_aside_takes_its_share_of_every_tick(pauses, share):
    aside = BackgroundComputation(thought("found", pauses), share)
    assert [aside.advance() for _ in range(pauses // share)] == [False] * (pauses // share)
    assert aside.result is None
    assert aside.advance()
    assert aside.result == "found"


BODIES = ("panda", "ur5e", "fr3")


class Counted:
    """What the local layer lends, counting how often a posture is worked out."""

    def __init__(self, safety):
        self._safety, self.count = safety, 0

    def tool(self, q):
        self.count += 1
        return self._safety.tool(q)

    def spheres(self, q, opening):
        return self._safety.spheres(q, opening)

    @property
    def closed(self):
        return self._safety.closed

    def project(self, *args):
        return self._safety.project(*args)


def crowded(robot):
    """A cube between walls that leave no clear way down to it."""
    things = [
        SceneObject(name="table", role="support", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.0))),
        SceneObject(
            name="cube", role="object", shape=Box((0.02, 0.02, 0.025)), pose=Pose((0.45, 0.1, 0.025)), error=0.009
        ),
    ]
    for k, (dx, dy) in enumerate([(0.06, 0.0), (-0.06, 0.0), (0.0, 0.06), (0.0, -0.06)]):
        things.append(
            SceneObject(
                name=f"wall{k}", role="object", shape=Box((0.01, 0.01, 0.1)), pose=Pose((0.45 + dx, 0.1 + dy, 0.1))
            )
        )
    return Scene(robot=robot, stamp=0.0, version=1, objects=tuple(things))


@pytest.mark.parametrize("robot", BODIES)
def test_no_tick_thinks_longer_than_its_share(robot):
    """In a crowd, where a grasp is chosen among dozens: thousands of postures, a few in every tick."""
    robot_model = load_robot(robot)
    lent, state, scene = Counted(SafetyFilter(robot_model)), home_state(robot_model), crowded(robot)
    limb = make_controller(robot_model, lent)
    assert isinstance(limb, ArmController)
    tool = lent.tool(state.q)
    words = {"object": "cube", "speed": 0.2, "clearance": 0.15, "finger_axis": "along", "opening": 0.06}
    running = SkillExecution(limb, "grasp", {**words, "approach": "top", "wait": "none", "force": 20.0})
    ticks, worst = 0, 0
    lent.count = 0
    while True:
        before = lent.count
        said = running.nominal(Observation(state=state, scene=scene, now=0.001 * ticks, tool=tool))
        worst = max(worst, lent.count - before)
        if said is not None:
            break
        ticks += 1
    assert isinstance(said, Nominal)
    assert worst <= 2 * steps_per_tick(
        robot_model.period
    )  # a glance is a posture, or two where one way ends and the next begins
    assert lent.count > 20 * worst
    assert ticks * robot_model.period < 3.0


def test_thinking_takes_the_same_share_of_every_period():
    assert steps_per_tick(0.001) == STEPS_PER_SECOND / 1000
    assert steps_per_tick(0.02) == STEPS_PER_SECOND / 50
    assert steps_per_tick(1e-6) == 1
    assert np.isclose(steps_per_tick(0.002) / 0.002, STEPS_PER_SECOND)
