"""One filter step on every body, in µs and as a ratio to the Panda's: the bodies take turns in one process.

    python benchmarks/bodies.py [--rounds 40]

Each stands at home, fingers open, in front of its first bare scene (a base in its empty room) and wishes for half its
speed; the median of the rounds' means is told.
"""

from __future__ import annotations

import argparse
import statistics
import time

import numpy as np

from dualbrain.embodiment.body import BODIES, load_body
from dualbrain.embodiment.robot import at_home
from dualbrain.runtime.desk import as_specified
from dualbrain.safety.barriers.traversable import traversable
from dualbrain.safety.filter import SafetyFilter
from dualbrain.safety.obstacles import from_scene
from dualbrain.world.catalogue import open_scene

STEPS = 500


def filter_of(name: str) -> SafetyFilter:
    body = load_body(name)
    scene = as_specified(open_scene("empty_room:0" if body.mobile else "bare:0", name))
    safety = SafetyFilter(body)
    safety.observe(
        (*from_scene(scene, known=(), held=None), *(traversable("floor", scene.region) if scene.region else ()))
    )
    return safety


def mean_us(safety: SafetyFilter) -> float:
    state = at_home(safety.body)
    wish = 0.5 * np.array([joint.velocity.value for joint in safety.body.joints])
    start = time.perf_counter()
    for _ in range(STEPS):
        safety.filter(state, wish, 0.0)
    return (time.perf_counter() - start) / STEPS * 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--rounds", type=int, default=40)
    filters = {name: filter_of(name) for name in BODIES}
    rounds = parser.parse_args().rounds
    times = {name: [] for name in filters}
    for _ in range(rounds):
        for name, safety in filters.items():
            times[name].append(mean_us(safety))
    panda = statistics.median(times["panda"])
    print("| body | n | spheres | µs | ratio to the Panda |\n|---|---|---|---|---|")
    for name, safety in filters.items():
        middle = statistics.median(times[name])
        print(f"| {name} | {safety.body.n} | {len(safety.body.spheres)} | {middle:.1f} | {middle / panda:.2f} |")


if __name__ == "__main__":
    main()
