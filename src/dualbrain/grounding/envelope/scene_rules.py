"""Envelope rules that depend on the scene and the robot, which a schema cannot express (third stage of the gate)."""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator, Mapping
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.contract import Action, Contract
from dualbrain.contracts.schema import DECLINE
from dualbrain.contracts.skill_order import SkillOrder
from dualbrain.contracts.verdict import Rejected
from dualbrain.grounding.envelope.grasp_fit import bears_force, is_level, least_opening
from dualbrain.grounding.envelope.grasp_reach import comes_down, highest_clearance
from dualbrain.grounding.envelope.object_limits import check_object_limits
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.model import RobotModel
from dualbrain.skills.arm.controller import ArmController
from dualbrain.skills.arm.grasp import FRAGILE_FRACTION
from dualbrain.skills.arm.grasp_planning import grasp_goal
from dualbrain.skills.kinematics.object_geometry import APPROACH_LEAN
from dualbrain.skills.mobile_base.controller import BaseController
from dualbrain.skills.mobile_base.drive_to import ARRIVAL_RADIUS
from dualbrain.skills.mobile_base.path_planning import clearance
from dualbrain.skills.mobile_manipulator import MobileManipulatorController
from dualbrain.skills.time_slicing import run_to_completion

TARGET_PARAMETERS = {"grasp": "object", "place": "destination", "push": "object", "move_to": "target"}
"""The parameter of each skill that names the target of the arm."""

BASE_MOTIONS = ("drive_to", "drive_to_pose", "turn_to")
"""Skills after which the pose of the base is another one."""
NEED_EMPTY_HAND, NEED_LOAD = ("grasp", "push"), ("place",)
"""Skills that need an empty hand, and skills that need a held object."""
FULL_HAND_HINT = "the hand is full: place or release first"
EMPTY_HAND_HINT = "nothing is held: grasp something first"

Rule = Callable[[Contract], Rejected | None]


def scene_rules(
    scene: Scene, controller: ArmController | BaseController | MobileManipulatorController
) -> tuple[Rule, ...]:
    """The rules for `scene` and the present state of the robot: held object, finger opening, reach, and the floor."""
    if isinstance(controller, MobileManipulatorController):
        return (
            _check_decline,
            lambda contract: _check_drive_targets(contract, scene, controller.base),
            lambda contract: _check_gripper_sequence(contract, controller.arm),
            lambda contract: check_object_limits(contract, scene, _held_name(controller.arm)),
            lambda contract: _check_fits(contract, scene, controller.arm.robot_model),
            lambda contract: _check_grasps_before_driving(contract, scene, controller),
            lambda contract: _check_reach_after_driving(contract, scene, controller),
        )
    if isinstance(controller, BaseController):
        return (_check_decline, lambda contract: _check_drive_targets(contract, scene, controller))
    return (
        _check_decline,
        lambda contract: _check_gripper_sequence(contract, controller),
        lambda contract: check_object_limits(contract, scene, _held_name(controller)),
        lambda contract: _check_grasps(contract, scene, controller),
    )


def _held_name(arm: ArmController) -> str | None:
    return arm.holding.name if arm.holding else None


def hand_after(skill: str, *, full: bool) -> bool | None:
    """Whether the hand is full after `skill`, if it was (not) `full` before; None if the skill is refused then."""
    if skill in NEED_EMPTY_HAND:
        return None if full else skill == "grasp"
    if skill in NEED_LOAD:
        return False if full else None
    return full and skill != "release"


def skill_order(skills: Collection[str], holding: str | None) -> SkillOrder:
    """The orders of `skills` that the rules about hand and decline accept while the hand holds `holding` (or nothing).

    A decoder that follows this order generates no contract that these rules reject, and every contract that they accept
    remains possible.
    """
    motions = [skill for skill in skills if skill != DECLINE]
    following = {state: _states_after(motions, full=state == "full") for state in ("empty", "full")}
    first = following["full" if holding else "empty"] | ({DECLINE: "declined"} if DECLINE in skills else {})
    return SkillOrder("first", {"first": first, **following, "declined": {}})


def _states_after(skills: Iterable[str], *, full: bool) -> dict[str, str]:
    """The state of the hand after each of `skills` that is accepted while the hand is (not) `full`."""
    after = {skill: hand_after(skill, full=full) for skill in skills}
    return {skill: "full" if is_full else "empty" for skill, is_full in after.items() if is_full is not None}


def _check_decline(contract: Contract) -> Rejected | None:
    skills = [action.skill for action in contract.action_sequence]
    if DECLINE in skills and len(skills) > 1:
        return Rejected(
            stage="envelope",
            pointer="/action_sequence",
            got=skills,
            allowed=[DECLINE],
            hint="decline stands alone: it refuses the whole instruction",
        )
    return None


def _check_drive_targets(contract: Contract, scene: Scene, base: BaseController) -> Rejected | None:
    """A drive target is a place, or a point on the drivable floor with room for the base."""
    places = [place.name for place in scene.places]
    for index, action in enumerate(contract.action_sequence):
        if action.skill == "drive_to" and action.params["place"] not in places:
            pointer, hint = f"/action_sequence/{index}/params/place", "nobody drives into a container: name a place"
            return Rejected(stage="envelope", pointer=pointer, got=action.params["place"], allowed=places, hint=hint)
        if action.skill == "drive_to_pose":
            spot = np.array([float(action.params["x"]), float(action.params["y"])])
            if float(clearance(base.with_keep_out_boxes(scene), spot)) < base.footprint_radius:
                hint = "the base has no room there: something stands there, or it is off the floor"
                pointer = f"/action_sequence/{index}/params"
                return Rejected(
                    stage="envelope", pointer=pointer, got=spot.tolist(), allowed="a free point of the floor", hint=hint
                )
    return None


def _check_gripper_sequence(contract: Contract, arm: ArmController) -> Rejected | None:
    """Skills grasp and push need an empty gripper, skill place needs a held object."""
    full = arm.holding is not None
    for index, action in enumerate(contract.action_sequence):
        after = hand_after(action.skill, full=full)
        if after is None:
            return Rejected(
                stage="envelope",
                pointer=f"/action_sequence/{index}/skill",
                got=action.skill,
                allowed=["place", "release"] if full else ["grasp"],
                hint=FULL_HAND_HINT if full else EMPTY_HAND_HINT,
            )
        full = after
    return None


def _check_grasps(contract: Contract, scene: Scene, arm: ArmController) -> Rejected | None:
    """The fingers fit around each object to grasp, and the arm reaches it."""
    for obj, params, pointer in _grasps(contract, scene):
        rejected = _check_fit(arm.robot_model, obj, params, pointer)
        if rejected := rejected or _check_reach(arm, obj, params, pointer):
            return rejected
    return None


def _check_fits(contract: Contract, scene: Scene, hand: RobotModel) -> Rejected | None:
    """The fingers fit around each object to grasp; unlike the reach, this does not depend on the pose of the base."""
    checks = (_check_fit(hand, *grasp) for grasp in _grasps(contract, scene))
    return next((rejected for rejected in checks if rejected), None)


def _grasps(contract: Contract, scene: Scene) -> Iterator[tuple[SceneObject, Mapping[str, Any], str]]:
    """Object, parameters and JSON pointer of the parameters for each grasp of `contract`."""
    for index, action in enumerate(contract.action_sequence):
        if action.skill == "grasp":
            yield scene.find(str(action.params["object"])), action.params, f"/action_sequence/{index}/params"


def _check_fit(hand: RobotModel, obj: SceneObject, params: Mapping[str, Any], pointer: str) -> Rejected | None:
    """The object bears the least force of the hand, and fits between the fingers along a level axis."""
    axis, least = str(params["finger_axis"]), hand.gripper.force_min.value
    if not bears_force(obj, least):
        return Rejected(
            stage="envelope",
            pointer=f"{pointer}/object",
            got=obj.name,
            allowed=f"things that bear {least / FRAGILE_FRACTION:.0f} N or more",
            hint=f"{obj.name} bears {obj.fragile_limit:.0f} N; this hand presses with at least {least:.0f} N: decline",
        )
    needed, widest = least_opening(obj, axis), 2.0 * hand.gripper.opening.value
    if rejected := _check_axis(obj, axis, widest, f"{pointer}/finger_axis"):
        return rejected
    if float(params["opening"]) < needed:
        fits = needed <= widest
        room = f"open wider than {obj.name} ({needed * 1000:.1f} mm with room)"
        narrower = f"things that need {widest * 1000:.0f} mm or less: {obj.name} needs {needed * 1000:.1f} mm"
        return Rejected(
            stage="envelope",
            pointer=f"{pointer}/opening",
            got=params["opening"],
            allowed={"minimum": needed, "maximum": widest} if fits else narrower,
            hint=room if fits else "it is too wide for this hand",
        )
    return None


def _check_axis(obj: SceneObject, axis: str, widest: float, pointer: str) -> Rejected | None:
    """The axis is level, and the object fits into the opening `widest` [m] along it, unless it fits along neither.

    At least one of the two axes is level: both cannot rise by more than 45 degrees.
    """
    other = "across" if axis == "along" else "along"
    fits_otherwise = is_level(obj, other) and least_opening(obj, other) <= widest
    if is_level(obj, axis) and (least_opening(obj, axis) <= widest or not fits_otherwise):
        return None
    hint = f"{obj.name} lies so that this axis points up: no finger can close along it"
    if is_level(obj, axis):
        hint = f"{obj.name} is too wide for this hand along this axis"
    elif not fits_otherwise:
        hint += f", and {other} it is too wide for this hand: decline"
    allowed = [other] if fits_otherwise else "an axis that is level and along which it fits between the fingers"
    return Rejected(stage="envelope", pointer=pointer, got=axis, allowed=allowed, hint=hint)


def _check_reach(arm: ArmController, obj: SceneObject, params: Mapping[str, Any], pointer: str) -> Rejected | None:
    """The arm reaches the grasp, and the pregrasp pose above it."""
    if run_to_completion(grasp_goal(arm, obj, str(params["finger_axis"]), str(params["approach"]))) is None:
        return Rejected(
            stage="envelope",
            pointer=f"{pointer}/object",
            got=obj.name,
            allowed="things within reach",
            hint=f"{obj.name} is out of reach for this grasp",
        )
    return _check_approach(arm, obj, params, pointer)


def _check_grasps_before_driving(
    contract: Contract, scene: Scene, robot: MobileManipulatorController
) -> Rejected | None:
    """Apply `_check_grasps` to the grasps before the first motion of the base; its pose after that is unknown yet."""
    moving = (i for i, action in enumerate(contract.action_sequence) if action.skill in BASE_MOTIONS)
    before = contract.action_sequence[: next(moving, None)]
    if not any(action.skill == "grasp" for action in before):
        return None
    robot.activate(driving=False)
    return _check_grasps(
        msgspec.structs.replace(contract, action_sequence=before), robot.arm.observation.scene, robot.arm
    )


def _check_reach_after_driving(contract: Contract, scene: Scene, robot: MobileManipulatorController) -> Rejected | None:
    """After a drive to a place, every target of the arm is within its reach there, for any heading."""
    places = {place.name: np.array(place.position[:2]) for place in scene.places}
    far = (
        _max_reach(robot.arm.robot_model)
        + float(np.hypot(*robot.arm.robot_model.joints[0].translation[:2]))
        + ARRIVAL_RADIUS
    )
    place: str | None = None
    for index, (action, spot) in enumerate(_target_positions(contract, scene, _held_name(robot.arm))):
        if action.skill == "drive_to":
            place = str(action.params["place"])
        elif action.skill == "drive_to_pose":
            place = None
        elif place in places and spot is not None and np.linalg.norm(spot - places[place]) > far:
            named = TARGET_PARAMETERS[action.skill]
            near = [name for name, at in places.items() if np.linalg.norm(spot - at) <= far]
            hint = f"out of reach from {place}: drive_to {' or '.join(near) or 'it'} before that"
            pointer = f"/action_sequence/{index}/params/{named}"
            return Rejected(
                stage="envelope", pointer=pointer, got=action.params[named], allowed={"reached from": near}, hint=hint
            )
    return None


def _target_positions(
    contract: Contract, scene: Scene, held: str | None
) -> Iterator[tuple[Action, NDArray[np.float64] | None]]:
    """Each action with the position (2,) [m] of its target on the floor; None without one, and if it is not known.

    A placed object is at its destination. An object that was pushed, released or still is in the hand (`held` before
    the first action) is at no known position.
    """
    moved: dict[str, NDArray[np.float64] | None] = {held: None} if held else {}
    for action in contract.action_sequence:
        target = str(action.params[TARGET_PARAMETERS[action.skill]]) if action.skill in TARGET_PARAMETERS else ""
        spot = moved[target] if target in moved else _floor_position(scene, target) if target else None
        yield action, spot
        if action.skill in ("grasp", "push"):
            moved[target] = None
        if action.skill == "place" and held:
            moved[held] = spot
        if action.skill in ("grasp", "place", "release"):
            held = target if action.skill == "grasp" else None


def _max_reach(arm: RobotModel) -> float:
    """Upper bound of the distance between tool and first joint axis [m]: the length of the stretched chain."""
    hand = next(link for link in arm.links if link.name == arm.tool.link)
    parts = [*(joint.translation for joint in arm.joints[1:]), hand.translation, arm.tool.translation]
    return float(sum(np.linalg.norm(part) for part in parts))


def _floor_position(scene: Scene, name: str) -> NDArray[np.float64]:
    """Position (2,) [m] of an object or a place in the plane of the floor."""
    spot = next((place.position for place in scene.places if place.name == name), None)
    return np.array((spot or scene.find(name).pose.position)[:2])


def _check_approach(arm: ArmController, obj: SceneObject, params: Mapping[str, Any], pointer: str) -> Rejected | None:
    """The arm reaches the pregrasp pose, at the given clearance and with the given approach."""
    axis, approach, clearance = str(params["finger_axis"]), str(params["approach"]), float(params["clearance"])
    if comes_down(arm, obj, axis, approach, clearance):
        return None
    highest = highest_clearance(arm, obj, axis, approach, clearance)
    if highest is not None:
        hint = f"the arm cannot come down on {obj.name} from so high with this approach: ask for less clearance"
        return Rejected(
            stage="envelope", pointer=f"{pointer}/clearance", got=clearance, allowed={"maximum": highest}, hint=hint
        )
    ways = [way for way in APPROACH_LEAN if way != approach]
    others = [way for way in ways if comes_down(arm, obj, axis, way, clearance)] or [
        way for way in ways if highest_clearance(arm, obj, axis, way, clearance) is not None
    ]
    hint = f"the arm cannot come to {obj.name} this way: choose another approach or finger axis"
    return Rejected(stage="envelope", pointer=f"{pointer}/approach", got=approach, allowed=others, hint=hint)
