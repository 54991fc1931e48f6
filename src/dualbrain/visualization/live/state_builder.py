"""Builds the state of the live view from one tick of the control loop."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.contract import Action
from dualbrain.control.recording.trace import DEAD_BAND
from dualbrain.core.geometry.shapes import Pose, Vector
from dualbrain.records import Scene
from dualbrain.robots.interface import RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.filter import FilterResult, SafetyFilter
from dualbrain.safety.cbf.obstacles import obstacles_from_scene
from dualbrain.visualization.live.motion.motion_geometry import (
    link_poses,
    nearest_pair,
    plan_steps,
    unfiltered_configuration,
)
from dualbrain.visualization.live.operator.operator_status import FilterLimit, Situation
from dualbrain.visualization.live.panel import commanded_speeds
from dualbrain.visualization.live.view_state import PlanStep, ViewState

Array = NDArray[np.float64]


@dataclass(frozen=True, slots=True, kw_only=True)
class Tick:
    """One tick at `t` [s].

    `q` [rad, m], `opening` [m] per finger or None, `u` and `u_nom` [rad/s] after and before the filter, `delta`,
    `h_min` [m] (NaN if unknown), `status` of the filter by name, `barriers` that bind, and the binding `pairs`: link,
    obstacle, h [m]. `action` and `check` are those of the supervisor. `skill` and `phase` are in words.
    """

    t: float
    scene: Scene
    q: Array
    opening: float | None
    u: Array
    u_nom: Array
    delta: float
    h_min: float
    status: str
    barriers: tuple[str, ...]
    pairs: tuple[tuple[str, str, float], ...]
    in_contract: bool
    skill: str
    phase: str
    action: str
    check: str


def tick_of_result(
    state: RobotState,
    scene: Scene,
    result: FilterResult,
    *,
    in_contract: bool,
    skill: str,
    phase: str,
    action: str,
    check: str,
) -> Tick:
    """The tick of a filter `result` at the measured `state`; the words are those of `Tick`."""
    return Tick(
        t=state.stamp,
        scene=scene,
        q=state.q,
        opening=state.opening,
        u=np.asarray(result.u, float),
        u_nom=np.asarray(result.u_nom, float),
        delta=result.delta,
        h_min=result.h_min,
        status=result.status.name,
        barriers=result.barriers,
        pairs=result.obstacle_pairs,
        in_contract=in_contract,
        skill=skill,
        phase=phase,
        action=action,
        check=check,
    )


class StateBuilder:
    """Adds averages since the start, kinematics, and the words for the operator to the numbers of a tick."""

    def __init__(self, robot_model: RobotModel) -> None:
        """Start without ticks."""
        self._robot_model, self._kinematics = robot_model, SafetyFilter(robot_model)
        self._ticks = self._interventions = 0
        self._delta_sum = 0.0
        self._plan: tuple[PlanStep, ...] = ()
        fixed = {link.name for link in robot_model.links if link.frame == 0}
        self._moving = np.array([sphere.link not in fixed for sphere in robot_model.spheres])

    def count(self, delta: float) -> None:
        """Count the δ of a tick of a contract for the averages."""
        self._ticks += 1
        self._delta_sum += delta
        self._interventions += delta > DEAD_BAND

    def set_plan(self, actions: tuple[Action, ...], scene: Scene, q: Array) -> None:
        """Show the steps of an accepted contract from now on."""
        x, y, z = self._kinematics.tool(q).position.tolist()
        self._plan = plan_steps(actions, scene, (x, y, z))

    def begin_step(self, index: int) -> None:
        """Mark the step `index` of the contract as the current one, and the earlier ones as done."""
        self._plan = tuple(replace(step, is_done=k < index, is_current=k == index) for k, step in enumerate(self._plan))

    def end_plan(self) -> None:
        """Show no plan any more."""
        self._plan = ()

    def build(self, tick: Tick, frames: Mapping[str, Pose], lines: tuple[str, ...]) -> ViewState:
        """The state for `tick`, with the pose of each link in `frames`, and the newest `lines` of text."""
        centres, radii, _ = self._kinematics.spheres(tick.q, tick.opening)
        margins = scene_margins(tick.scene)
        tool, nominal, filtered = self._tool_velocities(tick)
        moving = np.append(self._moving, np.ones(len(radii) - len(self._moving), bool))
        return ViewState(
            t=tick.t,
            frames=frames,
            scene=tick.scene,
            centres=centres,
            radii=radii,
            margins=margins,
            numbers=self._numbers(tick),
            lines=lines,
            situation=self._situation(tick),
            tool=tool,
            nominal_velocity=nominal,
            filtered_velocity=filtered,
            ghost=self._ghost(tick),
            nearest_pair=nearest_pair(tick.scene, margins, centres[moving], radii[moving], tick.h_min),
            limiting_links=frozenset(link for link, _, _ in tick.pairs[:1]) if tick.delta > DEAD_BAND else frozenset(),
            plan=self._plan,
        )

    def _numbers(self, tick: Tick) -> dict[str, float | str]:
        ticks = max(1, self._ticks)
        order = f" [{tick.action}: {tick.check}]" if tick.check else ""
        return {
            "h_min": tick.h_min,
            "delta": tick.delta,
            "Delta": self._delta_sum / ticks,
            "intervention_frequency": self._interventions / ticks,
            **commanded_speeds(self._robot_model, tick.u),
            "elapsed": tick.t,
            "phase": f"{tick.skill}: {tick.phase}{order}",
            "status": tick.status,
            "barriers": ", ".join(tick.barriers).replace("_", " "),
            "planner": "",
        }

    def _situation(self, tick: Tick) -> Situation:
        limit = None
        if tick.pairs:
            part, other, h = tick.pairs[0]
            found = tick.scene.find(other)
            limit = FilterLimit(
                part=part.replace("_", " "),
                other=other.replace("_", " "),
                clearance=h,
                is_person=found is not None and found.role == "person",
            )
        return Situation(
            t=tick.t,
            action=tick.action,
            check=tick.check,
            filter_status=tick.status,
            in_contract=tick.in_contract,
            phase=tick.phase,
            delta=tick.delta,
            speed_share=self._speed_share(tick),
            limit=limit,
        )

    def _speed_share(self, tick: Tick) -> float:
        """Speed of the filtered control relative to the nominal one, 1 if the latter is zero."""
        wanted = float(np.linalg.norm(tick.u_nom)) if len(tick.u_nom) == len(tick.u) else 0.0
        return float(np.linalg.norm(tick.u)) / wanted if wanted > 1e-6 else 1.0

    def _tool_velocities(self, tick: Tick) -> tuple[Vector, Vector | None, Vector]:
        tool = self._kinematics.tool(tick.q)
        linear = tool.jacobian[:3]
        nominal = _vector(linear @ tick.u_nom) if len(tick.u_nom) == len(tick.u) else None
        return _vector(tool.position), nominal, _vector(linear @ tick.u)

    def _ghost(self, tick: Tick) -> dict[str, Pose]:
        """Poses without the filter; empty if it changes nothing, and for a mobile base."""
        known = len(tick.u_nom) == len(tick.q)
        if self._robot_model.is_mobile or not known or tick.delta <= DEAD_BAND:
            return {}
        ahead = unfiltered_configuration(self._robot_model, tick.q, tick.u_nom)
        return link_poses(self._robot_model, ahead, tick.opening)


def scene_margins(scene: Scene) -> dict[str, float]:
    """Margin of the filter around each object [m]."""
    return {one.name: one.margin for one in obstacles_from_scene(scene, known=(), held=None)}


def _vector(values: Array) -> Vector:
    x, y, z = values.tolist()
    return (x, y, z)
