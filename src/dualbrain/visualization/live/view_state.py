"""State that the live view draws at one moment; built by the owner of the control loop and immutable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Pose, Vector
from dualbrain.records import Scene
from dualbrain.visualization.live.operator.operator_status import Situation

Array = NDArray[np.float64]

NO_POINTS: Array = np.zeros((0, 3))


@dataclass(frozen=True, slots=True, kw_only=True)
class PlanStep:
    """One step of the contract: its `label`, and the `position` [m] at which it is drawn."""

    label: str
    position: Vector
    is_done: bool = False
    is_current: bool = False


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewState:
    """State at time `t` [s].

    `frames`: pose of each link by name. `centres` (k, 3) [m] and `radii` (k,) [m]: spheres of the filter, with
    `clearances` (k,) [m], the least h of the rows of each sphere (empty if unknown). `margins`: inflation [m] of each
    object of the `scene` by the filter. `numbers`: h_min [m], delta, Delta, intervention_frequency, speed of the joints
    [rad/s], drive [m/s] and turn [rad/s] of a base, elapsed [s], and the texts phase, status, barriers (the active
    ones) and planner. `lines`: verdicts and other events, the newest last. `situation`: the facts behind the words for
    the operator.

    `tool` [m], `nominal_velocity` and `filtered_velocity` [m/s]: position of the tool and its velocity before and after
    the filter. `ghost`: pose of each link after a short time without the filter, empty if the filter changes nothing.
    `nearest_pair` [m]: end points of the segment between robot and object of which h_min is the clearance.
    `limiting_links`: links of which a row limits the motion. `plan`: the steps of the contract. `is_periodic`: further
    states follow at the rate of the view, also at rest, so that an old state shows that the robot does not report.
    """

    t: float
    frames: Mapping[str, Pose]
    scene: Scene
    centres: Array = field(default_factory=lambda: NO_POINTS)
    radii: Array = field(default_factory=lambda: NO_POINTS[:, 0])
    clearances: Array = field(default_factory=lambda: NO_POINTS[:, 0])
    margins: Mapping[str, float] = field(default_factory=dict[str, float])
    target: Vector | None = None
    numbers: Mapping[str, float | str] = field(default_factory=dict[str, float | str])
    lines: tuple[str, ...] = ()
    situation: Situation = field(default_factory=Situation)
    tool: Vector | None = None
    nominal_velocity: Vector | None = None
    filtered_velocity: Vector | None = None
    ghost: Mapping[str, Pose] = field(default_factory=dict[str, Pose])
    nearest_pair: tuple[Vector, Vector] | None = None
    limiting_links: frozenset[str] = frozenset()
    plan: tuple[PlanStep, ...] = ()
    is_periodic: bool = False
