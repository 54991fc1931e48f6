"""Objects that a hand can grasp, with the finger axes and openings that fit them: for the gate and for decoders.

The gate rejects a grasp that does not fit (`scene_rules.py`). `parameter_domains` states the same bounds as parts of
the parameter domain, so that a decoder cannot generate such a grasp and every grasp that fits remains possible.
"""

from __future__ import annotations

import math
from collections import defaultdict
from collections.abc import Collection, Iterable

from dualbrain.contracts.parameter_domains import ParameterDomain, ParameterDomains
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.skill_spec import ChoiceParameter, NumberParameter, SkillSpec
from dualbrain.grounding.envelope.object_limits import NumberBounds, common_bounds, number_bounds
from dualbrain.grounding.instruction.goals.action_bounds import is_there
from dualbrain.grounding.instruction.goals.goal import Condition, Goal, Held, Placed
from dualbrain.records import Scene, SceneObject
from dualbrain.skills.arm.grasp import FRAGILE_FRACTION
from dualbrain.skills.kinematics.object_geometry import grasp_width, levelness

MIN_LEVELNESS = 0.7
"""The fingers close only along an axis of an object that is about level: least length of its horizontal component."""
FINGER_MARGIN = 0.010
"""The opening of the fingers must exceed the width of the object by at least this [m]."""
RESOLUTION = 1e-4
"""The least openings are rounded up to this [m], for the gate and the decoder alike."""


def is_level(obj: SceneObject, finger_axis: str) -> bool:
    """Whether fingers can close along the named axis of `obj`."""
    return levelness(obj, finger_axis) >= MIN_LEVELNESS


def least_opening(obj: SceneObject, finger_axis: str) -> float:
    """The least opening of the fingers [m] for a grasp of `obj` along the named axis, a multiple of `RESOLUTION`."""
    return round(math.ceil((grasp_width(obj, finger_axis) + FINGER_MARGIN) / RESOLUTION - 1e-6) * RESOLUTION, 4)


def bears_force(obj: SceneObject, force: float) -> bool:
    """Whether `obj` bears `force` [N] on each finger, as far as it declares a limit."""
    return obj.fragile_limit is None or force <= FRAGILE_FRACTION * obj.fragile_limit


def parameter_domains(
    scene: Scene, registry: SkillRegistry, holding: str | None = None, graspable: Collection[str] | None = None
) -> ParameterDomains:
    """The domains of the skills that move objects in `scene`: objects that fit, within the limits of the site.

    A placed object is the one in the hand (`holding`) or one of `graspable` (all objects if None): where it is not
    known which, the loosest limit bounds the domain. Without limits only the skill `grasp` has an entry, and a robot
    without it has none.
    """
    skills = registry.by_name
    if "grasp" not in skills:
        return {}
    objects = [scene.find(name) for name in scene.graspable]
    carried = [obj for obj in objects if obj.name == holding or graspable is None or obj.name in graspable]
    domains = {"grasp": _grasp_domains(objects, skills["grasp"])}
    if "push" in skills and any(obj.limits for obj in objects):
        domains["push"] = _push_domains(objects, skills["push"])
    if "place" in skills and (bounds := common_bounds(skills["place"], carried)) != NumberBounds():
        domains["place"] = (ParameterDomain(least=dict(bounds.least), most=dict(bounds.most)),)
    return domains


def ungraspable(goal: Goal, scene: Scene, domains: ParameterDomains, holding: str | None = None) -> tuple[str, ...]:
    """The objects that a contract for `goal` has to grasp and that fit the hand along no axis, by `domains`.

    An object in the hand, or at its destination already, need not be grasped; of "one of the tins", another one can be.
    """
    if "grasp" not in domains:
        return ()
    graspable = {name for part in domains["grasp"] for name in part.admitted["object"]}
    needed = dict.fromkeys(name for condition in goal.conditions for name in _grasped(condition, scene, holding))
    return tuple(name for name in needed if name not in graspable)


def why_ungraspable(obj: SceneObject, registry: SkillRegistry) -> str:
    """Why no grasp of `obj` fits the hand of `registry`, as a clause for people; "" if one fits."""
    parameters = {parameter.name: parameter for parameter in registry.skill("grasp").parameters}
    axes, opening, force = parameters["finger_axis"], parameters["opening"], parameters["force"]
    assert isinstance(axes, ChoiceParameter)
    assert isinstance(opening, NumberParameter)
    assert isinstance(force, NumberParameter)
    if not bears_force(obj, force.lower):
        return (
            f"it bears {obj.fragile_limit:.0f} N, and this hand, which presses with at least {force.lower:.0f} N, may "
            f"grasp what bears {force.lower / FRAGILE_FRACTION:.0f} N or more"
        )
    level = [axis for axis in axes.choices if is_level(obj, axis)]
    if not level:
        return "its pose is such that the fingers can close along none of its axes"
    least = min(least_opening(obj, axis) for axis in level)
    if least > opening.upper:
        return f"it needs an opening of {least * 1000:.0f} mm, and this hand opens {opening.upper * 1000:.0f} mm"
    return ""


def _grasped(condition: Condition, scene: Scene, holding: str | None) -> tuple[str, ...]:
    """The objects that every contract for `condition` grasps."""
    match condition:
        case Placed(objects, count=None):
            return tuple(name for name in objects if name != holding and not is_there(name, condition, scene))
        case Held((name,)) if name != holding:
            return (name,)
        case _:
            return ()


def _grasp_domains(objects: Iterable[SceneObject], grasp: SkillSpec) -> tuple[ParameterDomain, ...]:
    """The parts of the parameter domain of the skill `grasp` in which `objects` fit into the hand.

    One part for objects and finger axes with the same bounds; an object that does not fit is in none.
    """
    by_name = {parameter.name: parameter for parameter in grasp.parameters}
    axes, opening, force = by_name["finger_axis"], by_name["opening"], by_name["force"]
    assert isinstance(axes, ChoiceParameter)
    assert isinstance(opening, NumberParameter)
    assert isinstance(force, NumberParameter)
    names = defaultdict[tuple[tuple[str, ...], float, NumberBounds], list[str]](list)
    for obj in (obj for obj in objects if bears_force(obj, force.lower)):
        by_opening = defaultdict[float, list[str]](list)
        for axis in (axis for axis in axes.choices if is_level(obj, axis)):
            by_opening[least_opening(obj, axis)].append(axis)
        for least, fitting in by_opening.items():
            if least <= opening.upper:
                names[tuple(fitting), least, number_bounds(grasp, obj.limits)].append(obj.name)
    return tuple(
        ParameterDomain(
            {"object": objects, "finger_axis": fitting}, {"opening": least, **dict(bounds.least)}, dict(bounds.most)
        )
        for (fitting, least, bounds), objects in names.items()
    )


def _push_domains(objects: Iterable[SceneObject], push: SkillSpec) -> tuple[ParameterDomain, ...]:
    """The parts of the parameter domain of the skill `push`: one for objects with the same bounds."""
    names = defaultdict[NumberBounds, list[str]](list)
    for obj in objects:
        names[number_bounds(push, obj.limits)].append(obj.name)
    return tuple(
        ParameterDomain({"object": found}, dict(bounds.least), dict(bounds.most)) for bounds, found in names.items()
    )
