"""Forward invariance of the filter in at least 1e8 worst-case steps within the stated bounds, judged in float64."""

from __future__ import annotations

import zlib
from collections.abc import Iterable
from functools import cache
from typing import Any

import numpy as np

from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.compiled._kernel import ReferenceDistance
from dualbrain.safety.cbf.filter import SafetyFilter
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.safety import random_scenes
from experiments.safety.adversary.classes import (
    CLASSES,
    MOVING_CLASSES,
    NEGATIVE_CONTROLS,
    STATIC_CLASSES,
    AdversaryClass,
)
from experiments.safety.adversary.tables import adversary_tables
from experiments.safety.reference_judge import build_judge, obstacle_rows

EPISODES_PER_UNIT, STEPS_PER_EPISODE = 20, 10_000
CLASS_CYCLE = [kind for kind in (*STATIC_CLASSES[:4], *STATIC_CLASSES, MOVING_CLASSES[0]) for _ in range(2)] + list(
    MOVING_CLASSES
)
"""The classes of one round: 25 units."""
ROUNDS, CONTROL_ROUNDS = 21, 2
SUMMED_FIELDS = (
    "steps",
    "status",
    "held",
    "still",
    "moving",
    "touched",
    "plans",
    "attacked",
    "contacts",
    "approaching",
    "jerks",
    "iterations",
    "rows",
)
MINIMUM_FIELDS = ("h_still", "h_self", "h_joint", "h_moving")
MAXIMUM_FIELDS = ("most_iterations", "most_rows", "approach")


class Adversary:
    """Forward invariance against an adversary with noise, message losses, lag and acceleration limits."""

    name = "adversary"
    claim = (
        "In at least 1e8 adversarial steps, no true h falls below zero among static obstacles in the documented "
        "configurations; a moving obstacle that leaves an escape is not approached at contact; each negative control "
        "fails, and a gain above that of braking does not."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Rounds over all classes; the first rounds include the negative controls."""
        del options
        kinds = [
            kind
            for round_ in range(ROUNDS)
            for kind in (*CLASS_CYCLE, *(NEGATIVE_CONTROLS if round_ < CONTROL_ROUNDS else ()))
        ]
        counts: dict[str, int] = {}
        units = []
        for kind in kinds:
            block = counts[kind.name] = counts.get(kind.name, -1) + 1
            units.append(WorkUnit(f"{kind.name} {block}", {"class": kind.name, "block": block}))
        return units

    def run(self, parameters: dict[str, Any]) -> Row:
        """`EPISODES_PER_UNIT` random scenes of `STEPS_PER_EPISODE` steps each."""
        kind, first = CLASSES[parameters["class"]], parameters["block"] * EPISODES_PER_UNIT
        counts = [run_episode(kind, seed) for seed in range(first, first + EPISODES_PER_UNIT)]
        worst = min(range(EPISODES_PER_UNIT), key=lambda i: counts[i]["h_still"])
        return {**parameters, **aggregate(counts), "worst": [first + worst, counts[worst]["worst_step"]]}

    def summarize_row(self, row: Row) -> str:
        """The smallest h and the number of steps with h < 0."""
        least = min(row["h_still"], row["h_self"])
        return f"h >= {least * 1e3:.3f} mm, below zero on {sum(row['still'])} of {row['steps']} steps"

    def report(self, rows: list[Row]) -> list[str]:
        """Static, moving and control classes; premises; violations by the premise that failed."""
        return adversary_tables({name: aggregate(group) for name, group in _by_class(rows)})


def run_episode(kind: AdversaryClass, seed: int, steps: int = STEPS_PER_EPISODE) -> Row:
    """The counts of one random scene and start posture."""
    return run_trial(kind, seed, steps)[0]


def run_trial(kind: AdversaryClass, seed: int, steps: int, *, log: bool = False) -> tuple[Row, np.ndarray, list[Any]]:
    """The counts, the true postures (steps, n) if `log`, and the true obstacles at the start."""
    robot_model, judge = load_panda()
    rng = np.random.default_rng([seed, zlib.crc32(kind.name.encode())])
    q = random_scenes.random_posture(robot_model, judge, rng)
    truth = random_scenes.random_obstacles(judge, q, rng, int(rng.integers(4, 15)))
    if kind.has_moving_obstacle:
        truth.append(random_scenes.random_moving_obstacle(judge, q, rng))
    safety = SafetyFilter(robot_model, kind.filter_config())
    safety.observe([kind.perceived_obstacle(obstacle) for obstacle in truth], 0.0)
    safety.reset()
    q, path = q.copy(), np.empty((steps, robot_model.n) if log else 0)
    counts = judge.run_worst_case_loop(
        safety._kernel.handles(), obstacle_rows(truth), kind.trial_parameters(seed, steps), q, path
    )
    return counts, path, truth


@cache
def load_panda() -> tuple[RobotModel, ReferenceDistance]:
    """The Panda with all spheres, fingers closed, and the reference distances for it."""
    robot_model = load_robot("panda")
    return robot_model, build_judge(robot_model)


def aggregate(counts: Iterable[Row]) -> Row:
    """Sums, minima and maxima of the counts of several episodes, element by element."""
    group = list(counts)
    columns = {key: np.array([one[key] for one in group]) for key in (*SUMMED_FIELDS, *MINIMUM_FIELDS, *MAXIMUM_FIELDS)}
    whole: Row = {key: columns[key].sum(axis=0).tolist() for key in SUMMED_FIELDS}
    whole |= {key: columns[key].min(axis=0).tolist() for key in MINIMUM_FIELDS}
    return whole | {key: columns[key].max(axis=0).tolist() for key in MAXIMUM_FIELDS}


def _by_class(rows: list[Row]) -> Iterable[tuple[str, list[Row]]]:
    for name in CLASSES:
        group = [row for row in rows if row["class"] == name]
        if group:
            yield name, group
