"""place: carry what is held to a container or place by the wanted route, lower it, let go, retreat."""

from __future__ import annotations

from itertools import product

import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.skill_spec import ContactPermit, NameParameter, SkillSpec
from dualbrain.core.geometry.shapes import Bowl
from dualbrain.records import Scene
from dualbrain.robots.model import RobotModel
from dualbrain.skills import parameters
from dualbrain.skills.arm.controller import ArmController, ToolGoal, goal_at_height
from dualbrain.skills.arm.grasp_planning import order_by_posture_cost, vary_goal
from dualbrain.skills.arm.waypoints import (
    descend,
    follow_waypoints,
    predict_waypoint_clearance,
    reach_goal,
    via_point,
    wait_for_people,
)
from dualbrain.skills.kinematics import object_geometry
from dualbrain.skills.skill import SkillResult, SkillRoutine, SkillStatus
from dualbrain.skills.time_slicing import SUFFICIENT_CLEARANCE, SlicedComputation, SlicedIterator, first_clear

Array = NDArray[np.float64]

RIM_CLEARANCE = 0.012
"""Room between what is held and the rim when letting go [m]."""
SLOW_DESCENT_HEIGHT = 0.04
"""How far above its release height a load is lowered gently [m]."""
RETREAT_HEIGHT = 0.08
"""How far the open hand rises before the skill ends [m]."""
RELEASE_YAWS = (0.0, 0.4, -0.4, 0.8, -0.8, 1.2, -1.2, 1.57)
"""Turns about the vertical by which a load may be let go otherwise [rad] …"""
RELEASE_ELBOW_SWINGS = (0.0, 0.4, -0.4)
"""… and swings of the elbow [rad]."""
MIN_RETREAT_HEIGHT = 0.045
"""A hand that was kept from rising all the way has let go when it rose this far [m]."""
DROP_HEIGHT = 0.004
"""Height above a support at which a thing is let go [m]."""


def spec(robot_model: RobotModel) -> SkillSpec:
    """The skill's vocabulary entry and the contacts it needs."""
    touch = parameters.CONTACT_SPEED
    return SkillSpec(
        "place",
        "carry what is held to a container or place, put it there and let go",
        (
            NameParameter("destination", "receptive", "where to put it"),
            parameters.speed(robot_model),
            parameters.clearance(),
            parameters.route(),
            parameters.wait(),
        ),
        (
            ContactPermit("rise", "held", "support", touch),
            ContactPermit("lower", "held", "destination", touch),
            ContactPermit("lower", "held", "support", touch),
            ContactPermit("open", "held", "destination", touch),
            ContactPermit("open", "held", "support", touch),
            ContactPermit("open", "fingers", "target", touch),
            ContactPermit("open", "hand", "target", touch),
            ContactPermit("retreat", "fingers", "target", touch),
            ContactPermit("retreat", "hand", "target", touch),
        ),
    )


def receiving_point(scene: Scene, destination: str) -> tuple[Array, float, float]:
    """Where `destination` receives things: position (3,) at its receiving height, radius, drop height [m]."""
    for place in scene.places:
        if place.name == destination:
            return np.asarray(place.position), 0.05, DROP_HEIGHT
    thing = scene.find(destination)
    radius = thing.shape.radius if isinstance(thing.shape, Bowl) else 0.05
    return np.array([*thing.pose.position[:2], object_geometry.top_height(thing)]), radius, RIM_CLEARANCE


def routine(
    arm: ArmController, *, destination: str, speed: float, clearance: float, route: str, wait: str
) -> SkillRoutine:
    """Tell the placing: wait, carry, lower, open, retreat, look."""
    held = arm.holding
    if held is None:
        return SkillResult(SkillStatus.FAILED, "nothing is held")
    support = arm.support
    arm.begin(
        spec(arm.robot_model), target=held.name, destination=destination, support=support.name if support else None
    )
    point, radius, room = receiving_point(arm.observation.scene, destination)
    spot_down = point + np.array([0.0, 0.0, room + held.below_tool])
    height = max(arm.support_height + clearance + held.below_tool, float(spot_down[2]) + SLOW_DESCENT_HEIGHT)
    down = yield from _find_release_goal(arm, spot_down, height, route, tilt=room == RIM_CLEARANCE)
    if down is None:
        return SkillResult(SkillStatus.FAILED, f"{destination} is out of reach")
    middle = (arm.observation.tool.position + point) / 2
    if wait == "until_clear" and (
        why := (yield from wait_for_people(arm, arm.current_goal(), middle, 4.0, "carry", speed, radius=0.35))
    ):
        return why
    above = goal_at_height(down, height)
    way = yield from _waypoints(arm, above, route)
    if why := (yield from follow_waypoints(arm, way, "carry", speed)) or _check_load_lost(arm, held.name):
        return why
    brink = goal_at_height(down, min(height, float(down.position[2]) + SLOW_DESCENT_HEIGHT))
    why = yield from descend(arm, above, brink, down, "lower", min(speed, 0.2), wait_phase="carry")
    if why or (why := _check_load_lost(arm, held.name)):
        return why
    yield from arm.open_gripper(arm.robot_model.gripper.opening.value)
    away = yield from _solve_at_height(arm, down, float(down.position[2]) + RETREAT_HEIGHT)
    why = yield from reach_goal(arm, away, "retreat", speed)
    risen = float(arm.observation.tool.position[2] - down.position[2])
    if why and not (why.status is SkillStatus.TAKEN_OVER and risen > MIN_RETREAT_HEIGHT):
        return why
    return _verify_placement(arm, held.name, destination, point, radius)


def _check_load_lost(arm: ArmController, name: str) -> SkillResult | None:
    """Why the load counts as lost, when the fingers no longer feel it; it is an obstacle again from then on."""
    if arm.is_gripping():
        return None
    arm.holding = None
    return SkillResult(SkillStatus.FAILED, f"carry: {name} was lost on the way")


def _find_release_goal(
    arm: ArmController, position: Array, height: float, route: str, *, tilt: bool
) -> SlicedComputation[ToolGoal | None]:
    """Where to let go at `position`, lowered from tool height `height` [m]: the clearest way of holding the hand."""

    def air(goal: ToolGoal, beat: float) -> SlicedComputation[float]:
        """Down and up again; and, where that is clear, on the way there."""
        below = yield from arm.predict_clearance(goal.posture, (), "lower")
        if below <= beat:
            return below
        above = yield from _solve_at_height(arm, goal, height)
        away = goal_at_height(goal, float(goal.position[2]) + RETREAT_HEIGHT)
        room = yield from arm.predict_clearance(above.posture, [goal, away], "lower", threshold=beat)
        if room < SUFFICIENT_CLEARANCE:
            return room
        way = yield from _waypoints(arm, goal_at_height(goal, height), route)
        return min(room, (yield from predict_waypoint_clearance(arm, way, "carry", beat)))

    best, _ = yield from first_clear(order_by_posture_cost(arm, _release_candidates(arm, position, tilt=tilt)), air)
    return best


def _release_candidates(arm: ArmController, position: Array, *, tilt: bool) -> SlicedIterator[ToolGoal]:
    """In the rotation held now, or turned with the arm's own swing when that lies more comfortably; or otherwise.

    Turned about the vertical, the elbow swung, and with `tilt` leaning.
    """
    here = arm.observation.tool
    swing = float(np.arctan2(position[1], position[0]) - np.arctan2(here.position[1], here.position[0]))
    turned = object_geometry.axis_rotation((0.0, 0.0, 1.0), swing) @ here.rotation
    plain = yield from arm.find_goal(position, [here.rotation.copy(), turned])
    if plain is None:
        return
    yield plain
    leans = (0.0, 0.2, -0.2, 0.4, -0.4) if tilt else (0.0,)
    for lean, yaw, elbow in product(leans, RELEASE_YAWS, RELEASE_ELBOW_SWINGS):
        goal = yield from vary_goal(arm, position, plain.rotation, yaw, lean, elbow)
        if goal is not None:
            yield goal


def _solve_at_height(arm: ArmController, goal: ToolGoal, height: float) -> SlicedComputation[ToolGoal]:
    """`goal` at tool height `height` [m]."""
    up = goal_at_height(goal, height)
    return arm.translate_goal(up, up.position)


def _waypoints(arm: ArmController, end: ToolGoal, route: str) -> SlicedComputation[list[ToolGoal]]:
    """The points to pass: straight up where needed, the route's bend, then above the destination."""
    here = arm.current_goal()
    height = float(end.position[2])
    points = [goal_at_height(here, height)] if here.position[2] < height - 0.01 else []
    via = via_point(here.position, end.position, route)
    if via is not None:
        points.append((yield from arm.translate_goal(end, via)))
    return [*points, end]


def _verify_placement(arm: ArmController, name: str, destination: str, point: Array, radius: float) -> SkillResult:
    """The robot's own verdict: is the thing perceived where it was put?"""
    away = float(np.linalg.norm(np.asarray(arm.find_object(name).pose.position)[:2] - point[:2]))
    if away > radius + arm.find_object(name).error:
        return SkillResult(SkillStatus.FAILED, f"{name} is {away * 100:.0f} cm from {destination} after letting go")
    return SkillResult(SkillStatus.DONE, f"{name} is at {destination}")
