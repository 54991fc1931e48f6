"""What the suite's own simulation shows to have gone too far: joint limits and touches, with peak and duration.

Limits are those of the Franka Emika Panda's data sheet, written down here a second time: nothing of the filter is read.
Needs numpy only: the suite's process keeps the account.
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
"""How far beyond its limit a joint may be before it counts [rad]."""
SPEED_TOLERANCE = 1.01
MIN_CONTACT_FORCE = 1.0
"""Normal force from which a touch counts [N]."""
MERGE_GAP_S = 0.05
"""Quiet that still belongs to the same breach [s]."""
UNITS = {"joint_velocity": "rad/s", "joint_position": "rad", "touch": "N"}
"""Kinds of breach, and what their peak is in: the greatest speed, how far beyond, the greatest normal force."""


@dataclass
class Breach:
    """One limit passed: when it began and was last seen [s], and its peak."""

    kind: str
    bodies: tuple[str, ...]
    start: float
    last_seen: float
    peak: float


class LimitMonitor:
    """Breaches of one flight; consecutive ones of a kind between the same parts are one."""

    def __init__(self) -> None:
        self._breaches: list[Breach] = []
        self._open_breaches: dict[tuple[str, tuple[str, ...]], Breach] = {}

    def update(self, now: float, q: Array, v: Array, touches: Mapping[tuple[str, str], float]) -> None:
        """Judge the state at `now` [s]: joints q, v (7,) and normal forces [N] between parts that should not meet."""
        for k in np.flatnonzero(np.abs(v) > SPEED_TOLERANCE * MAX_JOINT_SPEED).tolist():
            self._record("joint_velocity", (f"joint{k + 1}",), abs(float(v[k])), now)
        beyond = np.maximum(LOWER - q, q - UPPER)
        for k in np.flatnonzero(beyond > POSITION_TOLERANCE).tolist():
            self._record("joint_position", (f"joint{k + 1}",), float(beyond[k]), now)
        for between, force in touches.items():
            if force > MIN_CONTACT_FORCE:
                self._record("touch", between, force, now)

    def breaches(self) -> list[dict[str, Any]]:
        """All of them as JSON, in the order in which they began."""
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
        breach = Breach(kind, between, now, now, size)
        self._open_breaches[kind, between] = breach
        self._breaches.append(breach)
