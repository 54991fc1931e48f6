"""What the live view shows at one moment; made by the control loop's owner, never changed afterwards."""

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
    """One moment at `t` [s].

    `frames`: pose of each link of the body by name. `centres` (k, 3), `radii` (k,) [m]: the filter's spheres, with
    `clearances` (k,) [m], the least h of any row of each sphere (empty if unknown). `margins`: how far [m] the filter
    inflates each thing of the `scene`. `numbers`: h_min [m], delta, Delta, intervention_frequency, speed of the joints
    [rad/s], drive [m/s] and turn [rad/s] of a base, elapsed [s] and the words phase, status, barriers (those that
    bind), planner. `lines`: verdicts and other news, newest last.
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
