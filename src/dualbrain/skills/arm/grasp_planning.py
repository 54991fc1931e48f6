"""Where the hand goes to grasp a thing: as the contract has it, or a little otherwise where that would be too close."""

from __future__ import annotations

from collections.abc import Iterable
from itertools import chain, product

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Bowl, Capsule, Cylinder, Sphere
from dualbrain.records import SceneObject
from dualbrain.robots.model import Body
from dualbrain.skills.arm.controller import Goal, Limb, lifted
from dualbrain.skills.kinematics import object_geometry
from dualbrain.skills.kinematics.inverse_kinematics import BRIEF
from dualbrain.skills.time_slicing import Finds, Thought

Array = NDArray[np.float64]

FINGER_DEPTH = {"top": 0.016, "tilted": 0.008, "side": 0.008}
"""How far below a thing's top the tool may go [m]: the palm, 37 mm above the tool, keeps the filter's margins."""
FINGER_ROOM = 0.010
"""The open fingers want this much more than the width of the thing between them [m]."""
YAW, LEAN, SWING = 0.2, 0.15, 0.4
"""Steps by which a hand turns, leans, and an elbow swings, when the plain pose is too close to something [rad]."""
STEPS = 2
"""How many such steps a pose may be from the plain one."""


UNCOMFORTABLE = 1.6
"""A pose this much less comfortable than the first is tried last [rad]."""
OVER = 0.04
"""Room between finger tips and the top of a thing when passing over it [m]."""
BRINK = 0.03
"""Height of the finger tips above a thing's top from which they come down gently [m]."""


def grasp_height(body: Body, thing: SceneObject, approach: str) -> float:
    """Tool height [m] that holds `thing` around its middle, not lower than finger tips and palm allow."""
    low = object_geometry.bottom(thing) + body.gripper.pad_below_tool + 0.008
    middle = thing.pose.position[2]
    return max(low, middle, object_geometry.top(thing) - FINGER_DEPTH[approach])


def grasp_goal(limb: Limb, thing: SceneObject, finger_axis: str, approach: str) -> Thought[Goal | None]:
    """The plain tool pose that grasps `thing`; None when it is out of reach."""
    position, rotations = _plain(limb, thing, finger_axis, approach)
    return limb.goal(position, rotations)


def grasp_choices(limb: Limb, thing: SceneObject, finger_axis: str, approach: str) -> Finds[Goal]:
    """The plain pose, then poses a little otherwise; none when the plain one is out of reach."""
    plain = yield from grasp_goal(limb, thing, finger_axis, approach)
    if plain is not None:
        yield from comfortable_first(limb, chain([plain], _near(limb, thing, finger_axis, approach)))


def other_choices(limb: Limb, thing: SceneObject, finger_axis: str, approach: str) -> Finds[Goal]:
    """Poses on the other finger axis and with another approach than asked for, where the fingers fit."""
    other = {"along": "across", "across": "along"}[finger_axis]
    for axis, lean in (
        (other, approach),
        (finger_axis, "top"),
        (other, "top"),
        (finger_axis, "tilted"),
        (other, "tilted"),
    ):
        if (axis, lean) != (finger_axis, approach) and _fits(limb, thing, axis):
            yield from comfortable_first(limb, _near(limb, thing, axis, lean))


def comfortable_first(limb: Limb, goals: Iterable[Goal | None]) -> Finds[Goal]:
    """`goals` in their order, but last those that lie far less comfortably than the first: half a turn of the hand."""
    here, bound, later = limb.senses.state.q, np.inf, list[Goal]()
    for goal in goals:
        if goal is None:
            yield
            continue
        discomfort = limb.kinematics.discomfort(goal.posture, here)
        bound = discomfort + UNCOMFORTABLE if bound == np.inf else bound
        if discomfort <= bound:
            yield goal
        else:
            later.append(goal)
    yield from later


def descent_room(limb: Limb, at: Goal, thing: SceneObject, clearance: float, beat: float = -np.inf) -> Thought[float]:
    """Least room [m] on the way down from the station to `at`; none at all where the arm cannot come down.

    Where it ends is looked at first: what is too close is too close there, nearly always. `beat` as in `Limb.air`.
    """
    below = yield from limb.air(at.posture, (), "descend", limb.opening)
    if below <= beat:
        return below
    low = yield from brink(limb, at, thing)
    above = yield from limb.reachable(low, _over(limb, low, thing, clearance))
    if above is None:
        return -np.inf
    return (yield from limb.air(above.posture, [low, at], "descend", limb.opening, beat=beat))


def station(limb: Limb, at: Goal, thing: SceneObject, clearance: float) -> Thought[Goal]:
    """The pose from which the fingers come down: straight above the brink, tips clear of the thing's top."""
    low = yield from brink(limb, at, thing)
    return (yield from limb.shifted(low, _over(limb, low, thing, clearance)))


def _over(limb: Limb, low: Goal, thing: SceneObject, clearance: float) -> Array:
    tips = max(limb.floor + clearance, object_geometry.top(thing) + OVER)
    return lifted(low, tips + limb.body.gripper.pad_below_tool).position


def brink(limb: Limb, at: Goal, thing: SceneObject) -> Thought[Goal]:
    """The pose from which the fingers go on gently, back along the approach axis."""
    height = object_geometry.top(thing) + BRINK + limb.body.gripper.pad_below_tool
    axis = at.rotation[:, 2]
    back = max(0.0, height - float(at.position[2])) / -axis[2]
    return limb.shifted(at, at.position - back * axis)


def _near(limb: Limb, thing: SceneObject, finger_axis: str, approach: str) -> Finds[Goal]:
    position, rotations = _plain(limb, thing, finger_axis, approach)
    for turn, rotation in product(_turns(thing), rotations):
        goal = yield from posed(limb, position, rotation, *turn)
        if goal is not None:
            yield goal


def _turns(thing: SceneObject) -> list[tuple[float, float, float]]:
    """Yaw, lean and elbow swing [rad], the least departure first; a round thing may be turned around freely."""
    isround = isinstance(thing.shape, Cylinder | Sphere | Capsule | Bowl)
    yaws = range(-7, 8) if isround else range(-STEPS, STEPS + 1)
    counts = sorted(product(yaws, (-1, 0, 1), (-1, 0, 1)), key=lambda steps: (sum(map(abs, steps)), steps))
    near = [(a, b, c) for a, b, c in counts if (abs(b) + abs(c) + (0 if isround else abs(a))) <= STEPS]
    return [(a * YAW, b * LEAN, c * SWING) for a, b, c in near]


def posed(limb: Limb, position: Array, rotation: Array, yaw: float, lean: float, swing: float) -> Thought[Goal | None]:
    """The goal turned by `yaw` about the vertical and by `lean` about the fingers' axis, its elbow by `swing`."""
    turned = object_geometry.about((0.0, 0.0, 1.0), yaw) @ rotation
    turned = object_geometry.about(turned[:, 1], lean) @ turned
    start = limb.senses.state.q.copy()
    start[0] -= swing
    start[2] += swing
    q = yield from limb.kinematics.solve(position, turned, (start,), steps=BRIEF)
    return None if q is None else Goal(position, turned, q)


def _fits(limb: Limb, thing: SceneObject, axis: str) -> bool:
    """Whether the fingers, open as they are asked to be, go around `thing` on this axis, and it is level."""
    return (
        object_geometry.width(thing, axis) + FINGER_ROOM <= 2.0 * limb.opening
        and object_geometry.levelness(thing, axis) > 0.7
    )


def _plain(limb: Limb, thing: SceneObject, finger_axis: str, approach: str) -> tuple[Array, list[Array]]:
    """Position and rotations as the contract has them."""
    x, y, _ = thing.pose.position
    position = np.array([x, y, grasp_height(limb.body, thing, approach)])
    outward = np.array([x, y, 0.0]) / (np.hypot(x, y) + 1e-9)
    return position, object_geometry.grasp_rotations(
        object_geometry.finger_direction(thing, finger_axis), approach, outward
    )
