"""Limits of a site on force, speed and clearance for named objects: in the scene, for the gate, and for decoders.

The control loop adds the limits to each perceived scene, so that everything that reads the scene knows them. The gate
rejects a contract that exceeds them, from any planner, and a constrained decoder cannot generate most such contracts.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import reduce

import msgspec

from dualbrain.contracts.contract import Action, Contract
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.skill_spec import NumberParameter, SkillSpec
from dualbrain.contracts.verdict import Rejected
from dualbrain.records import ObjectLimits, Scene, SceneObject
from dualbrain.robots.site_config import SiteFile
from dualbrain.safety.cbf.obstacles import PersonLimits

OTHERS = "others"
"""Entry for every object that has no entry of its own."""
MOST = {"force": "force", "speed": "speed", "max_speed": "speed"}
"""Parameters with an upper bound, and the limit that bounds each."""
LEAST = {"clearance": "clearance"}
"""Parameters with a lower bound, and the limit that bounds each."""
OBJECT_SKILLS = frozenset({"grasp", "push"})
"""Skills that name the object which they move; every other skill moves the object in the hand."""
EMPTYING_SKILLS = frozenset({"place", "release"})


@dataclass(frozen=True, slots=True)
class NumberBounds:
    """Lower and upper bounds of the parameters of a skill, by the name of the parameter."""

    least: tuple[tuple[str, float], ...] = ()
    most: tuple[tuple[str, float], ...] = ()


def stated_limits(file: SiteFile) -> dict[str, ObjectLimits]:
    """The limits of the site file by name or category of the objects, with file and line."""
    return {
        name: ObjectLimits(
            force=entry.force, speed=entry.speed, clearance=entry.clearance, source=file.locate(f"object.{name}")
        )
        for name, entry in file.site.object.items()
    }


def site_object_limits(file: SiteFile, registry: SkillRegistry) -> dict[str, ObjectLimits]:
    """As `stated_limits`, checked against the vocabulary of a robot; a robot that cannot grasp keeps any limit.

    Raises:
        SiteError: no grasp in the vocabulary of `registry` could keep a limit.
    """
    limits, grasp = stated_limits(file), registry.by_name.get("grasp")
    if grasp is None:
        return limits
    for name, one in limits.items():
        if impossible := _find_impossible_limit(grasp, one):
            word, parameter = impossible
            bound = f"at least {parameter.lower:g}" if word in MOST.values() else f"at most {parameter.upper:g}"
            allowed = f"{bound} {parameter.unit}, the bound of every grasp of this robot"
            raise file.make_error(f"object.{name}.{word}", got=getattr(one, word), allowed=allowed)
    return limits


def with_object_limits(scene: Scene, limits: Mapping[str, ObjectLimits]) -> Scene:
    """`scene` in which each graspable object carries its limits.

    The entries of an object's name and of its category both apply, and the narrower number holds; `OTHERS` applies to
    an object with neither. Limits that a perceived scene states itself are replaced.
    """
    if not limits:
        return scene
    return msgspec.structs.replace(scene, objects=tuple(_with_limits(obj, limits) for obj in scene.objects))


def limits_in_words(scene: Scene, limits: Mapping[str, ObjectLimits]) -> tuple[str, ...]:
    """One line for each object of `scene` with limits, and for each entry of `limits` that matches no object."""
    objects = [obj for obj in scene.objects if obj.role == "object"]
    named = {word for obj in objects for word in (obj.name, obj.category)}
    return (
        *(f"limits of the site for {obj.name}: {describe_limits(obj.limits)}" for obj in objects if obj.limits),
        *(
            f"no object in this scene has the name or category {name!r} of the site's limits ({entry.source})"
            for name, entry in limits.items()
            if name != OTHERS and name not in named
        ),
    )


def absent_persons_in_words(scene: Scene, persons: PersonLimits | None) -> tuple[str, ...]:
    """One line for each entry of a person in `persons` that matches no person of `scene`."""
    present = [obj.name for obj in scene.objects if obj.role == "person"]
    found = f"persons in it: {', '.join(present)}" if present else "it has no person"
    named = sorted(persons.named - {*present, OTHERS}) if persons else []
    return tuple(f"no person in this scene has the name {name!r} of the site's limits; {found}" for name in named)


def describe_limits(limits: ObjectLimits) -> str:
    """The limits in words, such as "force at most 8 N, clearance at least 0.3 m (lab.toml:12)"."""
    bounds = (
        ("force", limits.force, "at most", "N"),
        ("speed", limits.speed, "at most", "m/s"),
        ("clearance", limits.clearance, "at least", "m"),
    )
    words = ", ".join(f"{name} {side} {value:g} {unit}" for name, value, side, unit in bounds if value is not None)
    return f"{words} ({limits.source})" if limits.source else words


def check_object_limits(contract: Contract, scene: Scene, holding: str | None) -> Rejected | None:
    """The rejection of the first number of `contract` beyond the limits of the object that is moved at that time.

    `holding` is the object in the hand at the beginning.
    """
    for index, action, name in _moved_objects(contract, holding):
        obj = next((one for one in scene.objects if one.name == name), None)
        if obj is not None and obj.limits is not None:
            rejected = _check_numbers(action, f"/action_sequence/{index}/params", obj, obj.limits)
            if rejected is not None:
                return rejected
    return None


def number_bounds(skill: SkillSpec, limits: ObjectLimits | None) -> NumberBounds:
    """The bounds of the number parameters of `skill` for an object with `limits`."""
    numbers = [parameter.name for parameter in skill.parameters if isinstance(parameter, NumberParameter)]
    return NumberBounds(_bounds(numbers, LEAST, limits), _bounds(numbers, MOST, limits))


def common_bounds(skill: SkillSpec, objects: Iterable[SceneObject]) -> NumberBounds:
    """The loosest bounds of the number parameters of `skill` for any of `objects`.

    A parameter has no bound if one of the objects has none, or if there are no objects.
    """
    each = [number_bounds(skill, obj.limits) for obj in objects]
    return NumberBounds(
        _loosest([dict(bounds.least) for bounds in each], min), _loosest([dict(bounds.most) for bounds in each], max)
    )


def _find_impossible_limit(grasp: SkillSpec, limits: ObjectLimits) -> tuple[str, NumberParameter] | None:
    """The first limit that no grasp could keep, with its parameter; None if there is none."""
    bounds = number_bounds(grasp, limits)
    least, most = dict(bounds.least), dict(bounds.most)
    for parameter in grasp.parameters:
        if isinstance(parameter, NumberParameter):
            name = parameter.name
            if most.get(name, parameter.upper) < parameter.lower or least.get(name, parameter.lower) > parameter.upper:
                return (MOST | LEAST)[name], parameter
    return None


def _with_limits(obj: SceneObject, limits: Mapping[str, ObjectLimits]) -> SceneObject:
    if obj.role != "object":
        return obj
    found = [limits[word] for word in dict.fromkeys((obj.name, obj.category)) if word in limits]
    if not found and OTHERS in limits:
        found = [limits[OTHERS]]
    own = reduce(_narrowest, found) if found else None
    return obj if own is obj.limits else msgspec.structs.replace(obj, limits=own)


def _narrowest(one: ObjectLimits, other: ObjectLimits) -> ObjectLimits:
    sources = dict.fromkeys(source for source in (one.source, other.source) if source)
    return ObjectLimits(
        force=_choose(min, one.force, other.force),
        speed=_choose(min, one.speed, other.speed),
        clearance=_choose(max, one.clearance, other.clearance),
        source=" and ".join(sources),
    )


def _choose(narrower: Callable[[Iterable[float]], float], *values: float | None) -> float | None:
    stated = [value for value in values if value is not None]
    return narrower(stated) if stated else None


def _moved_objects(contract: Contract, holding: str | None) -> Iterator[tuple[int, Action, str]]:
    """Index, action and name of the moved object for each action that moves one."""
    for index, action in enumerate(contract.action_sequence):
        name = str(action.params["object"]) if action.skill in OBJECT_SKILLS else holding
        if name is not None:
            yield index, action, name
        if action.skill == "grasp":
            holding = name
        elif action.skill in EMPTYING_SKILLS:
            holding = None


def _check_numbers(action: Action, pointer: str, obj: SceneObject, limits: ObjectLimits) -> Rejected | None:
    for name, value in action.params.items():
        most = getattr(limits, MOST[name]) if name in MOST else None
        least = getattr(limits, LEAST[name]) if name in LEAST else None
        if (most is not None and value > most) or (least is not None and value < least):
            return Rejected(
                stage="envelope",
                pointer=f"{pointer}/{name}",
                got=value,
                allowed={"maximum": most} if most is not None else {"minimum": least},
                hint=f"the site limits {obj.name}: {describe_limits(limits)}",
            )
    return None


def _bounds(
    numbers: Iterable[str], table: Mapping[str, str], limits: ObjectLimits | None
) -> tuple[tuple[str, float], ...]:
    found = ((name, getattr(limits, table[name], None)) for name in numbers if name in table)
    return tuple((name, value) for name, value in found if value is not None)


def _loosest(
    bounds: Sequence[Mapping[str, float]], looser: Callable[[Iterable[float]], float]
) -> tuple[tuple[str, float], ...]:
    names = bounds[0] if bounds else ()
    common = [name for name in names if all(name in one for one in bounds)]
    return tuple((name, looser([one[name] for one in bounds])) for name in common)
