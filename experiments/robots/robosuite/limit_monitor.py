"""Monitor of exceeded joint limits and contacts in the suite's own simulation, with peak and duration.

The limits are those of the Franka Emika Panda's data sheet, repeated here so that the monitor is independent of the
filter. The module needs only NumPy, because it runs in the suite's process.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

LOWER = np.array([-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973])
UPPER = np.array([2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973])
MAX_JOINT_SPEED = np.array([2.175, 2.175, 2.175, 2.175, 2.61, 2.61, 2.61])
"""Joint limits [rad], [rad], [rad/s]."""
POSITION_TOLERANCE = 1e-3
"""A joint position counts as a breach if it exceeds its limit by more than this [rad]."""
SPEED_TOLERANCE = 1.01
"""A joint speed counts as a breach if it exceeds its limit by more than this factor."""
MIN_CONTACT_FORCE = 1.0
"""Least normal force of a contact that counts [N]."""
MERGE_GAP_S = 0.05
"""Longest interruption within one breach [s]."""
UNITS = {"joint_velocity": "rad/s", "joint_position": "rad", "touch": "N"}
"""Kinds of breach with the unit of their peak: greatest speed, greatest excess, greatest normal force."""


@dataclass(kw_only=True)
class Breach:
    """One exceeded limit: its start and last observation [s], and its peak."""

    kind: str
    bodies: tuple[str, ...]
    start: float
    last_seen: float
    peak: float


class LimitMonitor:
    """Breaches of one episode; consecutive ones of the same kind and parts are one breach."""

    def __init__(self) -> None:
        self._breaches: list[Breach] = []
        self._open_breaches: dict[tuple[str, tuple[str, ...]], Breach] = {}

    def update(self, now: float, q: Array, v: Array, touches: Mapping[tuple[str, str], float]) -> None:
        """Judge the state at `now` [s]: joints q, v (7,) and normal forces [N] between parts that must not touch."""
        for k in np.flatnonzero(np.abs(v) > SPEED_TOLERANCE * MAX_JOINT_SPEED).tolist():
            self._record("joint_velocity", (f"joint{k + 1}",), abs(float(v[k])), now)
        beyond = np.maximum(LOWER - q, q - UPPER)
        for k in np.flatnonzero(beyond > POSITION_TOLERANCE).tolist():
            self._record("joint_position", (f"joint{k + 1}",), float(beyond[k]), now)
        for between, force in touches.items():
            if force > MIN_CONTACT_FORCE:
                self._record("touch", between, force, now)

    def breaches(self) -> list[dict[str, Any]]:
        """All breaches as JSON values, in the order in which they began."""
        return [
            {
                "kind": b.kind,
                "between": list(b.bodies),
                "start": round(b.start, 4),
                "duration": round(b.last_seen - b.start, 4),
                "peak": round(b.peak, 5),
            }
            for b in self._breaches
        ]

    def _record(self, kind: str, between: tuple[str, ...], size: float, now: float) -> None:
        known = self._open_breaches.get((kind, between))
        if known is not None and now - known.last_seen <= MERGE_GAP_S:
            known.last_seen, known.peak = now, max(known.peak, size)
            return
        breach = Breach(kind=kind, bodies=between, start=now, last_seen=now, peak=size)
        self._open_breaches[kind, between] = breach
        self._breaches.append(breach)
