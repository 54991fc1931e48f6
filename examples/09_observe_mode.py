"""Observe first, then switch on: a week beside your controller in three seconds.

Run: `python examples/09_observe_mode.py`. The shadow changes nothing; it writes one line for every episode in which the
filter would have stepped in, and sums up. The same controller then runs behind the filter.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from time import perf_counter

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Capsule, HalfSpace, Pose
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import Obstacle, SafetyFilter
from dualbrain.safety.integration.intervention_log import InterventionLog, read_intervention_log
from dualbrain.safety.integration.shadow_mode import ShadowFilter

Array = NDArray[np.float64]
BODY = load_robot("panda")
SCENE = [
    Obstacle("table", HalfSpace(), Pose((0.0, 0.0, 0.0))),
    Obstacle("post", Capsule(radius=0.03, half_length=0.2), Pose((0.45, 0.26, 0.2))),
]
TICKS = 3000


def my_controller(q: Array, now: float) -> Array:
    """Swings to the post and away from it, softly: acceleration is within the limits."""
    goal = np.array(BODY.home) + np.array([0.55 * (1.0 - np.cos(2.0 * now)), 0, 0, 0, 0, 0, 0])
    return 8.0 * (goal - q)


def scene_filter() -> SafetyFilter:
    """A filter that knows the scene; stamps and `now` are on one clock."""
    safety = SafetyFilter(BODY)
    safety.observe(SCENE, stamp=0.0)
    return safety


def run(shadow: ShadowFilter | None, safety: SafetyFilter | None) -> tuple[float, float]:
    """Drive the arm; nearest distance [m] to anything, and the median seconds of a tick's watching or filtering."""
    q, v, near, spent = np.array(BODY.home), np.zeros(BODY.n), np.inf, list[float]()
    for tick in range(TICKS):
        now = tick * BODY.period
        u = my_controller(q, now)
        began = perf_counter()
        answer = shadow.evaluate(q, v, u, now) if shadow else None
        answer = safety(q, v, u, now) if safety else answer
        spent.append(perf_counter() - began)
        near = min(near, answer.h_min) if answer else near
        if safety and answer:
            u = answer.u
        v = v + (u - v) * BODY.period / BODY.tracking.lag
        q = q + BODY.period * v
    return near, float(np.median(spent))


def main() -> None:
    """Watch, read the file, switch on."""
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "episodes.jsonl"
        with InterventionLog(path) as file:
            shadow = ShadowFilter(scene_filter(), on_interval=file)
            _, spent = run(shadow, None)
            print(f"observed: {shadow.close().explain()}")
            print(f"watching took {spent * 1e6:.0f} µs a tick\n")
        for episode in read_intervention_log(path):
            print(
                f"{episode.start:.3f}-{episode.end:.3f} s: {episode.cause}, {episode.worst},"
                f" {episode.ticks} ticks, least h {(episode.h_min or 0.0) * 1e3:.1f} mm"
            )
    near, _ = run(None, scene_filter())
    print(f"\nswitched on: nothing nearer than {near * 1e3:.1f} mm beyond all margins")


if __name__ == "__main__":
    main()
