"""Named alternatives of a task: contracts with the same steps and names that differ in few named levels.

Most of the variance of an outcome is due to how a contract fits the scene. A few named alternatives sample this
interaction with far fewer episodes than free numbers do. The levels are those of `skills/parameters.py`, and three that
depend on the scene: `fitted` opening and clearance (`parameter_values.py`) and the `free` or the `other` finger axis.
"""

from __future__ import annotations

from collections.abc import Mapping

from dualbrain.contracts.contract import Action, ParameterValue
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.skill_spec import ChoiceParameter, NumberParameter
from dualbrain.grounding.parameter_values import fitted_opening, path_clearance
from dualbrain.grounding.scene_paths import path_ends
from dualbrain.grounding.scene_summary import free_finger_axis
from dualbrain.records import Scene, SceneObject
from dualbrain.skills.parameters import LEVELS

SkillSteps = tuple[tuple[str, dict[str, ParameterValue]], ...]
"""Skills in order, each with the parameters that the task decides."""

COMMON_LEVELS: Mapping[str, str] = {
    "opening": "fitted",
    "finger_axis": "free",
    "clearance": "fitted",
    "speed": "normal",
    "approach": "top",
    "route": "direct",
    "wait": "none",
    "force": "firm",
    "distance": "middle",
    "max_speed": "normal",
    "max_turn_rate": "normal",
}
"""The level of each parameter in the alternative `fitted`."""
DEFAULT_ALTERNATIVE = "fitted"
"""The alternative without a changed level."""
CHANGED_LEVELS: Mapping[str, Mapping[str, str]] = {
    DEFAULT_ALTERNATIVE: {},
    "low": {"clearance": "low"},
    "middle": {"clearance": "middle"},
    "high": {"clearance": "high"},
    "slow": {"speed": "slow", "max_speed": "slow"},
    "fast": {"speed": "fast", "max_speed": "fast"},
    "near_base": {"route": "near_base"},
    "tilted": {"approach": "tilted"},
    "wait": {"wait": "until_clear"},
    "other_axis": {"finger_axis": "other"},
    "low_near_base": {"clearance": "low", "route": "near_base"},
    "high_near_base": {"clearance": "high", "route": "near_base"},
    "high_slow": {"clearance": "high", "speed": "slow"},
    "slow_turns": {"max_turn_rate": "slow"},
}
"""The alternatives by name, each with the levels that differ from `COMMON_LEVELS`."""


def alternatives(registry: SkillRegistry, scene: Scene, steps: SkillSteps) -> dict[str, tuple[Action, ...]]:
    """The alternatives of the task `steps` in `scene` by name; those that equal an earlier one are left out."""
    found: dict[str, tuple[Action, ...]] = {}
    for name, changes in CHANGED_LEVELS.items():
        actions = _actions(registry, scene, steps, {**COMMON_LEVELS, **changes})
        if actions not in found.values():
            found[name] = actions
    return found


def _actions(registry: SkillRegistry, scene: Scene, steps: SkillSteps, levels: Mapping[str, str]) -> tuple[Action, ...]:
    """The actions of `steps` with open parameters at `levels`."""
    actions: list[Action] = []
    for skill, given in steps:
        target = _handled_object(scene, steps, len(actions))
        destination = _destination(steps, len(actions))
        params: dict[str, ParameterValue] = {}
        for parameter in registry.skill(skill).parameters:
            if parameter.name in given:
                params[parameter.name] = given[parameter.name]
            elif isinstance(parameter, NumberParameter | ChoiceParameter):
                value = _value(scene, target, destination, parameter.name, levels)
                if isinstance(parameter, NumberParameter):
                    value = min(max(float(value), parameter.lower), parameter.upper)
                params[parameter.name] = value
        actions.append(Action(skill, params))
    return tuple(actions)


def _value(
    scene: Scene, target: SceneObject | None, destination: str, parameter: str, levels: Mapping[str, str]
) -> float | str:
    """The value of `parameter` at its level, for the object `target` on its way to `destination`.

    A path that the summary does not describe has the fitted clearance of the first one that it does, so that the value
    can be copied from the line of the object.
    """
    level = levels[parameter]
    if parameter == "finger_axis":
        return _finger_axis(scene, target, level)
    if level != "fitted":
        return LEVELS[parameter][level]
    if parameter == "opening":
        axis = _finger_axis(scene, target, levels["finger_axis"])
        return fitted_opening(target, axis) if target else LEVELS["opening"]["wide"]
    ends = path_ends(scene)
    end = next((one for one in ends if one.name == destination), ends[0] if ends else None)
    return path_clearance(scene, target, end) if target and end else LEVELS["clearance"]["middle"]


def _finger_axis(scene: Scene, target: SceneObject | None, level: str) -> str:
    free = free_finger_axis(scene, target) if target else "along"
    return free if level == "free" else "across" if free == "along" else "along"


def _handled_object(scene: Scene, steps: SkillSteps, index: int) -> SceneObject | None:
    """The object that step `index` grasps, carries, pushes or moves to; None if the scene has no such object."""
    names = [str(given["object"]) for _, given in steps[: index + 1] if "object" in given]
    name = str(steps[index][1].get("target", names[-1] if names else ""))
    return next((obj for obj in scene.objects if obj.name == name), None)


def _destination(steps: SkillSteps, index: int) -> str:
    """The destination of the object that step `index` handles, "" if it has none."""
    return next((str(given["destination"]) for _, given in steps[index:] if "destination" in given), "")
