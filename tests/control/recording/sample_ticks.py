"""Reproducible ticks of an imaginary control loop."""

from dataclasses import dataclass

import numpy as np

from dualbrain.control.recording.trace import Array, Trace
from dualbrain.robots.interface import RobotState


@dataclass(frozen=True)
class FakeFilterResult:
    """The logged fields of a filter result."""

    u: Array
    status: int = 0
    delta: float = 0.0
    delta_rows: float = 0.0
    delta_box: float = 0.0
    h_min: float = 0.1
    certified: bool = True
    iterations: int = 3
    n_rows: int = 90
    delta_supervisor: float = 0.0


def append_ticks(trace: Trace, count: int, *, start: float = 0.0, special_values: bool = False) -> list[Array]:
    """Append `count` ticks; `special_values` adds NaN, infinities, a negative zero and a subnormal number."""
    rng = np.random.default_rng(7)
    rows: list[Array] = []
    for k in range(count):
        t = start + k * 1e-3
        q, u_nom = rng.normal(size=trace.n), rng.normal(size=trace.n)
        result = FakeFilterResult(u_nom.astype(np.float32), delta=float(rng.random()), h_min=float(rng.normal()))
        if special_values:
            q[k % trace.n] = (np.nan, -0.0, np.inf, 5e-324)[k % 4]
            result = FakeFilterResult(result.u, h_min=(np.inf if k % 2 else -np.inf))
        state = RobotState(
            stamp=t,
            sequence=k,
            q=q,
            v=-q,
            opening=0.04,
            finger_forces=(0.0, 1.0),
            torques=2.0 * u_nom,
            wrench=np.arange(6.0) + t,
        )
        rows.append(trace.append(t, state, u_nom, result, action=k // 100, phase=("approach", "lift")[k // 150 % 2]))
    return rows
