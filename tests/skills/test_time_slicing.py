"""Sliced computations: the choice with the largest clearance, and a bounded number of steps in every control tick."""

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

clearance_lists = st.lists(st.floats(-0.1, 0.1), max_size=8)


def computation(result, pauses=0):
    """A sliced computation that returns `result` after that many pauses."""
    for _ in range(pauses):
        yield
    return result


@given(clearance_lists, st.floats(-0.05, 0.05))
def test_the_first_clear_choice_is_taken_else_the_clearest(clearances, threshold):
    evaluated = []

    def clearance(index, most):
        evaluated.append(index)
        return computation(clearances[index] if clearances[index] > most else most - 0.001)

    choice, most = run_to_completion(first_clear(range(len(clearances)), clearance))
    clear = [index for index, value in enumerate(clearances) if value >= SUFFICIENT_CLEARANCE]
    if clear:
        assert choice == clear[0]
        assert evaluated == list(range(clear[0] + 1))
    elif clearances:
        assert clearances[choice] == most == max(clearances)
    else:
        assert choice is None
    threshold = min(threshold, SUFFICIENT_CLEARANCE - 1e-6)
    taken, _ = run_to_completion(first_clear(range(len(clearances)), clearance, threshold=threshold))
    assert (taken is None) == (not clearances or max(clearances) <= threshold)


@given(st.integers(0, 20), st.integers(1, 6))
def test_a_background_computation_takes_its_share_of_every_tick(pauses, share):
    background = BackgroundComputation(computation("found", pauses), share)
    assert [background.advance() for _ in range(pauses // share)] == [False] * (pauses // share)
    assert background.result is None
    assert background.advance()
    assert background.result == "found"


ROBOTS = ("panda", "ur5e", "fr3")


class CountingMotionModel:
    """Motion model for skills that counts how often a tool pose is computed."""

    def __init__(self, safety):
        self._safety, self.count = safety, 0

    def tool(self, q):
        self.count += 1
        return self._safety.tool(q)

    def spheres(self, q, opening):
        return self._safety.spheres(q, opening)

    def damped_least_squares(self, *args):
        return self._safety.damped_least_squares(*args)

    @property
    def keep_out_boxes(self):
        return self._safety.keep_out_boxes

    def project(self, *args):
        return self._safety.project(*args)


def crowded(robot):
    """A cube between walls that leave no grasp of it clear."""
    objects = [
        SceneObject(name="table", role="support", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.0))),
        SceneObject(
            name="cube", role="object", shape=Box((0.02, 0.02, 0.025)), pose=Pose((0.45, 0.1, 0.025)), error=0.009
        ),
    ]
    for k, (dx, dy) in enumerate([(0.06, 0.0), (-0.06, 0.0), (0.0, 0.06), (0.0, -0.06)]):
        objects.append(
            SceneObject(
                name=f"wall{k}", role="object", shape=Box((0.01, 0.01, 0.1)), pose=Pose((0.45 + dx, 0.1 + dy, 0.1))
            )
        )
    return Scene(robot=robot, stamp=0.0, version=1, objects=tuple(objects))


@pytest.mark.parametrize("robot", ROBOTS)
def test_no_tick_computes_more_than_its_share(robot):
    """Among crowded objects a grasp is chosen from dozens: thousands of postures, a few in every tick."""
    robot_model = load_robot(robot)
    motion, state, scene = CountingMotionModel(SafetyFilter(robot_model)), home_state(robot_model), crowded(robot)
    controller = make_controller(robot_model, motion)
    assert isinstance(controller, ArmController)
    tool = motion.tool(state.q)
    params = {"object": "cube", "speed": 0.2, "clearance": 0.15, "finger_axis": "along", "opening": 0.06}
    execution = SkillExecution(controller, "grasp", {**params, "approach": "top", "wait": "none", "force": 20.0})
    ticks, worst = 0, 0
    motion.count = 0
    while True:
        before = motion.count
        result = execution.nominal(Observation(state=state, scene=scene, now=0.001 * ticks, tool=tool))
        worst = max(worst, motion.count - before)
        if result is not None:
            break
        ticks += 1
    assert isinstance(result, Nominal)
    # a step computes one posture, or two where one path ends and the next begins
    assert worst <= 2 * steps_per_tick(robot_model.period)
    assert motion.count > 20 * worst
    assert ticks * robot_model.period < 3.0


def test_a_computation_takes_the_same_share_of_every_period():
    assert steps_per_tick(0.001) == STEPS_PER_SECOND / 1000
    assert steps_per_tick(0.02) == STEPS_PER_SECOND / 50
    assert steps_per_tick(1e-6) == 1
    assert np.isclose(steps_per_tick(0.002) / 0.002, STEPS_PER_SECOND)
