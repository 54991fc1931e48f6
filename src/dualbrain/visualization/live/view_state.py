"""State that the live view draws at one moment; built by the owner of the control loop and immutable."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Pose, Vector
from dualbrain.records import Scene

Array = NDArray[np.float64]

NO_POINTS: Array = np.zeros((0, 3))


@dataclass(frozen=True, slots=True, kw_only=True)
class ViewState:
    """State at time `t` [s].

    `frames`: pose of each link by name. `centres` (k, 3) [m] and `radii` (k,) [m]: spheres of the filter, with
    `clearances` (k,) [m], the least h of the rows of each sphere (empty if unknown). `margins`: inflation [m] of each
    object of the `scene` by the filter. `numbers`: h_min [m], delta, Delta, intervention_frequency, speed of the joints
    [rad/s], drive [m/s] and turn [rad/s] of a base, elapsed [s], and the texts phase, status, barriers (the active
    ones) and planner. `lines`: verdicts and other events, the newest last.
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
