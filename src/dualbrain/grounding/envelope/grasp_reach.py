"""Reach of a grasp: the clearances from which an arm can come down on an object, for the gate and for decoders.

The gate rejects a grasp whose pregrasp pose is out of reach (`scene_rules.py`). `within_reach` states the same bounds
as parts of the parameter domain. Both take the highest clearance as a multiple of `CLEARANCE_STEP`.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from math import inf

import numpy as np

from dualbrain.contracts.parameter_domains import ParameterDomain, ParameterDomains
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.interface import home_state
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.skills import parameters
from dualbrain.skills.arm.controller import ArmController, ToolGoal
from dualbrain.skills.arm.grasp_planning import grasp_goal, pregrasp_goal
from dualbrain.skills.kinematics.object_geometry import APPROACH_LEAN
from dualbrain.skills.skill import Observation
from dualbrain.skills.time_slicing import run_to_completion

CLEARANCE_STEP = 0.01
"""Step [m] of the search for the highest clearance; it ends at the bounds of the parameter."""


def highest_clearance(
    arm: ArmController, obj: SceneObject, axis: str, approach: str, at_most: float = inf
) -> float | None:
    """The highest clearance `at_most` [m] from which the arm comes down on `obj`; None if there is none."""
    grasp = run_to_completion(grasp_goal(arm, obj, axis, approach))
    if grasp is None:
        return None
    steps = (height for height in reversed(_steps()) if height <= at_most)
    return next((height for height in steps if _is_reachable(arm, obj, grasp, height)), None)


def comes_down(arm: ArmController, obj: SceneObject, axis: str, approach: str, clearance: float) -> bool:
    """Whether the arm comes down on `obj` from `clearance` [m], which is at most the highest clearance."""
    grasp = run_to_completion(grasp_goal(arm, obj, axis, approach))
    if grasp is None or not _is_reachable(arm, obj, grasp, clearance):
        return False
    higher = (height for height in _steps() if height >= clearance)
    return any(height == clearance or _is_reachable(arm, obj, grasp, height) for height in higher)


def _is_reachable(arm: ArmController, obj: SceneObject, grasp: ToolGoal, clearance: float) -> bool:
    """Whether the arm reaches the pose from which it comes down to `grasp`, with the tips at `clearance` [m]."""
    pregrasp = run_to_completion(pregrasp_goal(arm, grasp, obj, clearance))
    solution = arm.kinematics.solve(pregrasp.position, pregrasp.rotation, (pregrasp.posture,))
    return run_to_completion(solution) is not None


def within_reach(
    domains: ParameterDomains, scene: Scene, arm: ArmController, graspable: Collection[str]
) -> ParameterDomains:
    """`domains` with the grasps of the `graspable` objects of `scene` only, by approach, up to the highest clearance.

    An object that is out of reach from every side, or only within reach below the least clearance of the site, keeps
    its parts, so that the gate states the reason.
    """
    if "grasp" not in domains:
        return domains
    names = defaultdict[_Reach, list[str]](list)
    for part in domains["grasp"]:
        for name in (name for name in part.admitted["object"] if name in graspable):
            for reach in _reaches(part, scene.find(name), arm):
                names[reach].append(name)
    return {**domains, "grasp": tuple(reach.domain(found) for reach, found in names.items())}


def arm_in_posture(robot_model: RobotModel, scene: Scene, q: Sequence[float], opening: float | None) -> ArmController:
    """The controller of a fixed arm that observed `scene`, at rest at `q` (n,) [rad], each finger at `opening` [m]."""
    safety = SafetyFilter(robot_model)
    arm, rest = ArmController(robot_model, safety), home_state(robot_model)
    state = replace(rest, q=np.asarray(q, np.float64), opening=opening)
    arm.observe(Observation(state=state, scene=scene, now=0.0, tool=safety.tool(state.q)))
    return arm


@dataclass(frozen=True, slots=True, kw_only=True)
class _Reach:
    """Finger axes and approaches with the same highest clearance [m], and the other bounds of their part."""

    axes: tuple[str, ...]
    approaches: tuple[str, ...]
    highest: float
    least: tuple[tuple[str, float], ...]
    most: tuple[tuple[str, float], ...]

    def domain(self, names: Sequence[str]) -> ParameterDomain:
        """The part for the objects with these `names`; a bound of the whole domain is not repeated."""
        admitted = {"object": names, "finger_axis": self.axes}
        if len(self.approaches) < len(APPROACH_LEAN):
            admitted["approach"] = self.approaches
        most = dict(self.most)
        if self.highest < parameters.clearance().upper:
            most["clearance"] = min(self.highest, most.get("clearance", self.highest))
        return ParameterDomain(admitted, dict(self.least), most)


def _reaches(part: ParameterDomain, obj: SceneObject, arm: ArmController) -> Iterator[_Reach]:
    """The reach of each group of finger axes of `part`; that of the whole part if no grasp of `obj` is within reach."""
    least, most, axes = tuple(part.least.items()), tuple(part.most.items()), tuple(part.admitted["finger_axis"])
    by_approach = defaultdict[tuple[tuple[str, ...], float], list[str]](list)
    for axis in axes:
        by_bound = defaultdict[float, list[str]](list)
        for approach in APPROACH_LEAN:
            bound = highest_clearance(arm, obj, axis, approach)
            if bound is not None and bound >= part.least.get("clearance", bound):
                by_bound[bound].append(approach)
        for bound, approaches in by_bound.items():
            by_approach[tuple(approaches), bound].append(axis)
    if not by_approach:
        highest = parameters.clearance().upper
        yield _Reach(axes=axes, approaches=tuple(APPROACH_LEAN), highest=highest, least=least, most=most)
    for (approaches, bound), along in by_approach.items():
        yield _Reach(axes=tuple(along), approaches=approaches, highest=bound, least=least, most=most)


def _steps() -> list[float]:
    """The clearances [m] of the search, ascending from the lower to the upper bound of the parameter."""
    bounds = parameters.clearance()
    first, last = round(bounds.lower / CLEARANCE_STEP), round(bounds.upper / CLEARANCE_STEP)
    return [round(count * CLEARANCE_STEP, 4) for count in range(first, last + 1)]
