"""Tool poses that grasp an object: as the contract specifies, or a variation if that pose has too little clearance."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain, product

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Bowl, Capsule, Cylinder, Sphere
from dualbrain.records import SceneObject
from dualbrain.robots.model import RobotModel
from dualbrain.skills.arm.controller import ArmController, ToolGoal, goal_at_height
from dualbrain.skills.kinematics import object_geometry
from dualbrain.skills.kinematics.inverse_kinematics import MAX_STEPS_PER_CANDIDATE
from dualbrain.skills.time_slicing import SlicedComputation, SlicedIterator

Array = NDArray[np.float64]

FINGER_DEPTH = {"top": 0.016, "tilted": 0.008, "side": 0.008}
"""Depth of the tool below the top of an object [m]: the palm, 37 mm above the tool, keeps the filter's margins."""
FINGER_CLEARANCE = 0.010
"""Margin of the finger opening beyond the width of the object between the fingers [m]."""
YAW_STEP, LEAN_STEP, ELBOW_STEP = 0.2, 0.15, 0.4
"""Steps of yaw, lean and elbow swing of variations [rad]."""
MAX_VARIATION_STEPS = 2
"""Most steps of a variation."""


MAX_EXTRA_POSTURE_COST = 1.6
"""Poses whose posture cost exceeds that of the first pose by this much are tried last [rad]."""
PASSING_CLEARANCE = 0.04
"""Clearance between finger tips and the top of an object when passing over it [m]."""
SLOW_DESCENT_HEIGHT = 0.03
"""Height of the finger tips above the top of an object from which they descend slowly [m]."""


def grasp_height(robot_model: RobotModel, obj: SceneObject, approach: str) -> float:
    """Tool height [m] that grasps `obj` around its middle, but not lower than finger tips and palm allow."""
    low = object_geometry.bottom_height(obj) + robot_model.gripper.pad_below_tool + 0.008
    middle = obj.pose.position[2]
    return max(low, middle, object_geometry.top_height(obj) - FINGER_DEPTH[approach])


def grasp_goal(
    arm: ArmController, obj: SceneObject, finger_axis: str, approach: str
) -> SlicedComputation[ToolGoal | None]:
    """The tool goal that grasps `obj` as specified, or None if it is out of reach."""
    position, rotations = _nominal_grasp(arm, obj, finger_axis, approach)
    return arm.find_goal(position, rotations)


def grasp_candidates(arm: ArmController, obj: SceneObject, finger_axis: str, approach: str) -> SlicedIterator[ToolGoal]:
    """The specified pose, then variations; nothing if the specified pose is out of reach."""
    specified = yield from grasp_goal(arm, obj, finger_axis, approach)
    if specified is not None:
        yield from order_by_posture_cost(arm, chain([specified], _grasp_variations(arm, obj, finger_axis, approach)))


def alternative_grasps(
    arm: ArmController, obj: SceneObject, finger_axis: str, approach: str, opening: float | None = None
) -> SlicedIterator[ToolGoal]:
    """Poses with the other finger axis or another approach than specified, if the fingers fit.

    The fingers are at `opening` [m each], by default as specified.
    """
    width = 2.0 * (arm.opening if opening is None else opening)
    other = {"along": "across", "across": "along"}[finger_axis]
    for axis, lean in (
        (other, approach),
        (finger_axis, "top"),
        (other, "top"),
        (finger_axis, "tilted"),
        (other, "tilted"),
    ):
        if (axis, lean) != (finger_axis, approach) and _fits_in_gripper(obj, axis, width):
            yield from order_by_posture_cost(arm, _grasp_variations(arm, obj, axis, lean))


def order_by_posture_cost(arm: ArmController, goals: Iterable[ToolGoal | None]) -> SlicedIterator[ToolGoal]:
    """`goals` in their order, but last those with a much larger posture cost than the first (half a hand turn)."""
    here, bound, later = arm.observation.state.q, np.inf, list[ToolGoal]()
    for goal in goals:
        if goal is None:
            yield
            continue
        cost = arm.kinematics.posture_cost(goal.posture, here)
        bound = cost + MAX_EXTRA_POSTURE_COST if bound == np.inf else bound
        if cost <= bound:
            yield goal
        else:
            later.append(goal)
    yield from later


def descent_clearance(
    arm: ArmController,
    grasp: ToolGoal,
    obj: SceneObject,
    clearance: float,
    threshold: float = -np.inf,
    opening: float | None = None,
) -> SlicedComputation[float]:
    """Least clearance [m] of the descent to `grasp`; minus infinity if the arm cannot descend there.

    The fingers are at `opening` [m each], by default as specified.

    The final pose is evaluated first, because a descent without clearance nearly always lacks it there. `threshold` as
    in `ArmController.predict_clearance`.
    """
    opening = arm.opening if opening is None else opening
    below = yield from arm.predict_clearance(grasp.posture, (), "descend", opening)
    if below <= threshold:
        return below
    low = yield from slow_descent_goal(arm, grasp, obj)
    above = yield from arm.translate_goal_if_reachable(low, _passing_position(arm, low, obj, clearance))
    if above is None:
        return -np.inf
    return (yield from arm.predict_clearance(above.posture, [low, grasp], "descend", opening, threshold=threshold))


def pregrasp_goal(
    arm: ArmController, grasp: ToolGoal, obj: SceneObject, clearance: float
) -> SlicedComputation[ToolGoal]:
    """The goal from which the fingers descend: straight above the slow descent, tips clear of the top of the object."""
    low = yield from slow_descent_goal(arm, grasp, obj)
    return (yield from arm.translate_goal(low, _passing_position(arm, low, obj, clearance)))


def _passing_position(arm: ArmController, low: ToolGoal, obj: SceneObject, clearance: float) -> Array:
    tips = max(arm.support_height + clearance, object_geometry.top_height(obj) + PASSING_CLEARANCE)
    return goal_at_height(low, tips + arm.robot_model.gripper.pad_below_tool).position


def slow_descent_goal(arm: ArmController, grasp: ToolGoal, obj: SceneObject) -> SlicedComputation[ToolGoal]:
    """The goal from which the fingers descend slowly, back along the approach axis."""
    height = object_geometry.top_height(obj) + SLOW_DESCENT_HEIGHT + arm.robot_model.gripper.pad_below_tool
    axis = grasp.rotation[:, 2]
    back = max(0.0, height - float(grasp.position[2])) / -axis[2]
    return arm.translate_goal(grasp, grasp.position - back * axis)


def _grasp_variations(
    arm: ArmController, obj: SceneObject, finger_axis: str, approach: str
) -> SlicedIterator[ToolGoal]:
    position, rotations = _nominal_grasp(arm, obj, finger_axis, approach)
    for turn, rotation in product(_variation_angles(obj), rotations):
        goal = yield from vary_goal(arm, position, rotation, *turn)
        if goal is not None:
            yield goal


def _variation_angles(obj: SceneObject) -> list[tuple[float, float, float]]:
    """Yaw, lean and elbow swing [rad], the smallest variation first; yaw is free for round objects."""
    is_round = isinstance(obj.shape, Cylinder | Sphere | Capsule | Bowl)
    yaws = range(-7, 8) if is_round else range(-MAX_VARIATION_STEPS, MAX_VARIATION_STEPS + 1)
    counts = sorted(product(yaws, (-1, 0, 1), (-1, 0, 1)), key=lambda steps: (sum(map(abs, steps)), steps))
    near = [(a, b, c) for a, b, c in counts if (abs(b) + abs(c) + (0 if is_round else abs(a))) <= MAX_VARIATION_STEPS]
    return [(a * YAW_STEP, b * LEAN_STEP, c * ELBOW_STEP) for a, b, c in near]


def vary_goal(
    arm: ArmController, position: Array, rotation: Array, yaw: float, lean: float, swing: float
) -> SlicedComputation[ToolGoal | None]:
    """The goal turned by `yaw` about the vertical and by `lean` about the finger axis, its elbow swung by `swing`."""
    turned = object_geometry.axis_rotation((0.0, 0.0, 1.0), yaw) @ rotation
    turned = object_geometry.axis_rotation(turned[:, 1], lean) @ turned
    start = arm.observation.state.q.copy()
    start[0] -= swing
    start[2] += swing
    q = yield from arm.kinematics.solve(position, turned, (start,), steps=MAX_STEPS_PER_CANDIDATE)
    return None if q is None else ToolGoal(position, turned, q)


def _fits_in_gripper(obj: SceneObject, axis: str, width: float) -> bool:
    """Whether fingers that are `width` [m] apart fit around `obj` on this axis, and the axis is level."""
    return (
        object_geometry.grasp_width(obj, axis) + FINGER_CLEARANCE <= width
        and object_geometry.levelness(obj, axis) > 0.7
    )


def _nominal_grasp(arm: ArmController, obj: SceneObject, finger_axis: str, approach: str) -> tuple[Array, list[Array]]:
    """Position and rotations as the contract specifies."""
    x, y, _ = obj.pose.position
    position = np.array([x, y, grasp_height(arm.robot_model, obj, approach)])
    outward = np.array([x, y, 0.0]) / (np.hypot(x, y) + 1e-9)
    return position, object_geometry.grasp_rotations(
        object_geometry.finger_direction(obj, finger_axis), approach, outward
    )
