"""Shadow mode first, then the active filter, with the same controller.

Run: `python examples/05_shadow_mode.py`. In shadow mode the filter changes nothing; it logs every interval in which it
would have intervened, and summarises them. Then the same controller runs behind the active filter.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from dualbrain import Capsule, HalfSpace, Obstacle, Pose, SafetyFilter, ShadowFilter, load_robot
from dualbrain.safety import InterventionLog, read_intervention_log

Array = NDArray[np.float64]
PANDA = load_robot("panda")
OBSTACLES = [
    Obstacle("table", HalfSpace()),
    Obstacle("post", Capsule(radius=0.03, half_length=0.2), Pose((0.45, 0.26, 0.2))),
]
TICKS = 3000


def my_controller(q: Array, now: float) -> Array:
    """Swing to the post and back, with accelerations within the limits."""
    goal = np.array(PANDA.home) + np.array([0.55 * (1.0 - np.cos(2.0 * now)), 0, 0, 0, 0, 0, 0])
    return 8.0 * (goal - q)


def run(shadow: ShadowFilter | None, safety: SafetyFilter | None) -> tuple[float, float]:
    """Move the arm; returns the smallest clearance [m] and the median filter time of a tick [s]."""
    q, v, clearance, times = np.array(PANDA.home), np.zeros(PANDA.n), np.inf, list[float]()
    for tick in range(TICKS):
        now = tick * PANDA.period
        u = my_controller(q, now)
        started = perf_counter()
        result = shadow.evaluate(q, v, u, now) if shadow else None
        result = safety(q, v, u, now) if safety else result
        times.append(perf_counter() - started)
        clearance = min(clearance, result.h_min) if result else clearance
        if safety and result:
            u = result.u
        v = v + (u - v) * PANDA.period / PANDA.tracking.lag
        q = q + PANDA.period * v
    return clearance, float(np.median(times))


def main() -> None:
    """Run in shadow mode, read the log, run with the active filter."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "interventions.jsonl"
        with InterventionLog(path) as log:
            shadow = ShadowFilter(SafetyFilter(PANDA, obstacles=OBSTACLES), on_interval=log)
            _, time = run(shadow, None)
            print(f"shadow mode: {shadow.close().explain()}")
            print(f"time of a tick: {time * 1e6:.0f} µs\n")
        for interval in read_intervention_log(path):
            print(
                f"{interval.start:.3f}-{interval.end:.3f} s: {interval.cause}, {interval.worst},"
                f" {interval.ticks} ticks, minimum h {(interval.h_min or 0.0) * 1e3:.1f} mm"
            )
    clearance, _ = run(None, SafetyFilter(PANDA, obstacles=OBSTACLES))
    print(f"\nactive filter: minimum clearance {clearance * 1e3:.1f} mm beyond all margins")


if __name__ == "__main__":
    main()
