"""Choice of the grasp: the requested one if it is clear, a slightly different one next to a neighbouring object."""

from dataclasses import replace

import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box, Cylinder, HalfSpace, Pose
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.contact_force.estimate import ContactForce
from dualbrain.skills.arm import grasp
from dualbrain.skills.arm.controller import ArmController, ToolGoal
from dualbrain.skills.arm.grasp_planning import (
    alternative_grasps,
    descent_clearance,
    grasp_candidates,
    grasp_goal,
    order_by_posture_cost,
    pregrasp_goal,
    slow_descent_goal,
)
from dualbrain.skills.kinematics import object_geometry
from dualbrain.skills.skill import Observation, SkillResult, SkillStatus
from dualbrain.skills.time_slicing import SUFFICIENT_CLEARANCE, collect, first_clear, run_to_completion

BODY = load_robot("panda")
TABLE = SceneObject(name="table", role="support", shape=HalfSpace(), pose=Pose((0.0, 0.0, 0.0)))
CUBE = SceneObject(
    name="cube", role="object", shape=Box((0.02, 0.02, 0.025)), pose=Pose((0.5, -0.2, 0.025)), error=0.009
)
BOTTLE = SceneObject(
    name="bottle", role="object", shape=Box((0.02, 0.03, 0.1)), pose=Pose((0.595, -0.2, 0.1)), error=0.009
)
BLOCK = SceneObject(
    name="block", role="object", shape=Box((0.015, 0.015, 0.02)), pose=Pose((0.575, -0.2, 0.02)), error=0.009
)
"""Beside one finger of a grasp "along"."""
CLEARANCE = 0.15


def arm_beside(*neighbours):
    """An arm at home that is about to grasp the cube."""
    safety, state = SafetyFilter(BODY), home_state(BODY)
    arm = ArmController(BODY, safety)
    arm.observe(
        Observation(
            state=state,
            scene=Scene(robot="panda", stamp=0.0, version=1, objects=(TABLE, CUBE, *neighbours)),
            now=0.0,
            tool=safety.tool(state.q),
        )
    )
    arm.begin(grasp.spec(BODY), target="cube", support="table")
    return arm


def choose(arm, axis="along", approach="top"):
    choices = grasp_candidates(arm, CUBE, axis, approach)
    return run_to_completion(first_clear(choices, lambda at, most: descent_clearance(arm, at, CUBE, CLEARANCE, most)))


def requested_grasp(arm, axis="along", approach="top"):
    return run_to_completion(grasp_goal(arm, CUBE, axis, approach))


@pytest.mark.parametrize("approach", object_geometry.APPROACH_LEAN)
@pytest.mark.parametrize("axis", ["along", "across"])
def test_an_object_without_neighbours_is_grasped_as_requested(axis, approach):
    arm = arm_beside()
    at, room = choose(arm, axis, approach)
    plain = requested_grasp(arm, axis, approach)
    assert room >= SUFFICIENT_CLEARANCE
    assert np.array_equal(at.rotation, plain.rotation)
    assert np.array_equal(at.posture, plain.posture)


def test_beside_a_neighbour_another_grasp_with_more_clearance_is_chosen():
    arm = arm_beside(BOTTLE)
    plain = run_to_completion(descent_clearance(arm, requested_grasp(arm), CUBE, CLEARANCE))
    at, room = choose(arm)
    assert plain < 0.0
    assert room > plain + 0.005
    assert np.allclose(at.position, requested_grasp(arm).position)


def test_alternative_grasps_differ_from_the_requested_one():
    arm = arm_beside(BOTTLE)
    requested = requested_grasp(arm).rotation
    for at in collect(alternative_grasps(arm, CUBE, "along", "top")):
        same_axis = abs(at.rotation[:, 1] @ requested[:, 1]) > 0.9
        assert not (same_axis and at.rotation[2, 2] < -np.cos(0.17))


def test_an_object_wider_than_the_opening_has_no_alternative_grasps():
    arm = arm_beside()
    arm.opening = 0.024
    assert not collect(alternative_grasps(arm, CUBE, "along", "top"))


def test_a_round_object_may_be_grasped_from_all_sides():
    arm = arm_beside()
    can = SceneObject(name="cube", role="object", shape=Cylinder(0.02, 0.025), pose=CUBE.pose, error=0.009)
    fingers = np.array([at.rotation[:2, 1] for at in collect(grasp_candidates(arm, can, "along", "top"))])
    angles = np.unique(np.round(np.arctan2(fingers[:, 1], fingers[:, 0]) % np.pi, 1))
    assert len(angles) > 12


def test_the_hand_descends_along_its_approach_direction():
    arm = arm_beside()
    at = requested_grasp(arm, "along", "tilted")
    low, above = (
        run_to_completion(slow_descent_goal(arm, at, CUBE)),
        run_to_completion(pregrasp_goal(arm, at, CUBE, CLEARANCE)),
    )
    back = low.position - at.position
    assert np.allclose(back / np.linalg.norm(back), -at.rotation[:, 2])
    assert np.allclose(above.position[:2], low.position[:2])
    assert above.position[2] - BODY.gripper.pad_below_tool >= CLEARANCE - 1e-9


def test_goals_are_ordered_by_the_joint_motion_they_need():
    arm = arm_beside()
    start = arm.observation.state.q
    plain = requested_grasp(arm)
    offsets = [0.0, 3.0, 0.5, 1.0, 4.0]
    goals = [ToolGoal(plain.position, plain.rotation, start + np.array([offset, *[0.0] * 6])) for offset in offsets]
    order = [float((goal.posture - start)[0]) for goal in collect(order_by_posture_cost(arm, goals))]
    assert order == pytest.approx([0.0, 0.5, 1.0, 3.0, 4.0])


def test_closer_fingers_have_more_clearance_beside_a_neighbour():
    arm = arm_beside(BLOCK)
    at = requested_grasp(arm)
    room = [
        run_to_completion(descent_clearance(arm, at, CUBE, CLEARANCE, opening=opening))
        for opening in (0.03, 0.035, 0.04)
    ]
    assert room[0] > room[1] > room[2]
    arm.opening = 0.035
    assert run_to_completion(descent_clearance(arm, at, CUBE, CLEARANCE)) == room[1]


@pytest.mark.parametrize("clear_at", [0.04, 0.032, None])
def test_the_fingers_come_closer_only_if_needed_and_only_above_the_object(monkeypatch, clear_at):
    """Fingers that close beside the object could push it away."""
    arm, events = arm_beside(BOTTLE), []
    at, blocked = requested_grasp(arm), SkillResult(SkillStatus.TAKEN_OVER, "descend: no progress")

    def find(_arm, obj, opening, goals, clearance):
        del obj, goals, clearance
        events.append(("find", opening, arm.opening))
        yield from ()
        return at if clear_at is not None and opening <= clear_at + 1e-9 else None

    def move(name):
        def moved(*_, **__):
            events.append((name, arm.opening))
            yield from ()

        return moved

    monkeypatch.setattr(grasp, "_find_clear_descent", find)
    monkeypatch.setattr(grasp, "move_to_height", move("rise"))
    monkeypatch.setattr(grasp, "_descend_to_grasp", move("descend"))
    result = run_to_completion(grasp._try_alternative(arm, blocked, CUBE, "along", "top", CLEARANCE, 0.2))
    looks = [("find", 0.04, 0.04)] if clear_at == 0.04 else [("find", 0.04, 0.04), ("find", pytest.approx(0.032), 0.04)]
    moves = [] if clear_at is None else [("rise", 0.04), ("descend", pytest.approx(clear_at))]
    assert events == looks + moves
    assert result is (blocked if clear_at is None else None)


def test_without_force_sensing_fingers_that_press_on_something_stay_where_they_are(monkeypatch):
    arm, blocked = arm_beside(BOTTLE), SkillResult(SkillStatus.TAKEN_OVER, "descend: no progress")
    pressing = replace(arm.observation.state, finger_forces=(0.0, 5.0))
    arm.observe(replace(arm.observation, state=pressing))
    monkeypatch.setattr(grasp, "move_to_height", None)
    assert run_to_completion(grasp._try_alternative(arm, blocked, CUBE, "along", "top", CLEARANCE, 0.2)) is blocked


def test_a_descent_that_ends_above_its_goal_is_blocked(monkeypatch):
    def at_once(*_, **__):
        yield from ()

    arm = arm_beside(BOTTLE)
    monkeypatch.setattr(grasp, "_approach", at_once)
    monkeypatch.setattr(grasp, "descend", at_once)
    result = run_to_completion(grasp._descend_to_grasp(arm, CUBE, requested_grasp(arm), CLEARANCE, 0.2))
    assert result.status is SkillStatus.TAKEN_OVER
    assert "press" in result.reason


@pytest.mark.parametrize(
    ("upward", "uncertainty", "place", "presses"),
    [
        (6.0, 2.0, "tool", True),
        (4.0, 2.0, "tool", False),
        (6.0, 7.0, "tool", False),
        (-9.0, 2.0, "tool", False),
        (9.0, 2.0, "panda_link3", False),
    ],
)
def test_the_hand_presses_if_the_force_at_the_tool_exceeds_limit_and_error(upward, uncertainty, place, presses):
    arm, force = arm_beside(BOTTLE), (0.0, 0.0, upward)
    estimate = ContactForce(
        stamp=0.0, vector=force, magnitude=abs(upward), place=place, uncertainty=uncertainty, load=0.0, felt_load=0.0
    )
    arm.observe(replace(arm.observation, contact_force=estimate))
    assert grasp._presses_down(arm) is presses
