"""Ten million fuzzed observations: bytes that are reinterpreted as numbers, in tables of obstacles of random sizes.

After each observation the filter makes one step. If the observation was refused, the step must stop the robot; in every
case the control must be finite and within the limits of the robot.
"""

from __future__ import annotations

import time
from collections import Counter
from functools import cache
from typing import Any

import numpy as np

from dualbrain.core.geometry.shapes import Box, Capsule, Cylinder, HalfSpace, Pose, Sphere
from dualbrain.errors import DualbrainError
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import FilterStatus, Obstacle, SafetyFilter
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.interfaces.fuzz_socket import resident_kib

N_OBSERVATIONS = 10_000_000
OBSERVATIONS_PER_UNIT = 100_000
MAX_OBSTACLES_AT_ONCE = 4
PLAUSIBLE_SHARE = 0.6
"""Share of numbers that are plausible; the others are random bits of a double or a special value."""
SPECIAL_VALUES = (
    0.0,
    -0.0,
    np.nan,
    np.inf,
    -np.inf,
    5e-324,
    1e-40,
    -1e-9,
    1e30,
    -3.5e38,
    1e300,
    1e-170,
    1000.0,
    1001.0,
)
WARM_UP = 1_000


@cache
def _safety_filter() -> SafetyFilter:
    return SafetyFilter(load_robot("panda"))


class FuzzObservations:
    """Refused and accepted observations, wrong answers, memory and time."""

    name = "fuzz_observations"
    claim = (
        "10⁷ fuzzed observations are each accepted or refused by an error of dualbrain; after a refusal the robot is "
        "stopped, every control is finite and within the limits, and memory does not grow."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Return the units by seed."""
        del options
        units = range(N_OBSERVATIONS // OBSERVATIONS_PER_UNIT)
        return [WorkUnit(f"seed {seed}", {"seed": seed, "observations": OBSERVATIONS_PER_UNIT}) for seed in units]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Observe and step; the row counts the outcomes and lists the wrong outcomes."""
        rng, safety = np.random.default_rng(parameters["seed"]), _safety_filter()
        q, limits = np.array(safety.robot_model.home), [joint.velocity.value for joint in safety.robot_model.joints]
        v, u = np.zeros(len(q)), np.full(len(q), 0.3)
        counts, problems, longest, start, before = Counter[str](), list[str](), 0.0, 0.0, 0
        for number in range(parameters["observations"] + WARM_UP):
            if number == WARM_UP:
                before, start = resident_kib(), time.process_time()
                counts.clear()
                longest = 0.0
            began = time.process_time()
            outcome = _observe(safety, rng)
            answer = safety(q, v, u, opening=0.02)
            longest = max(longest, time.process_time() - began)
            counts[outcome] += 1
            counts[f"step {answer.status.name}"] += 1
            if problem := _problem(outcome, answer.status, answer.u, limits):
                problems.append(f"observation {number}: {problem}")
        grown, spent = resident_kib() - before, time.process_time() - start
        counts = Counter({name: int(count) for name, count in counts.items()})
        return {"counts": counts, "problems": problems, "grown_kib": grown, "seconds": spent, "longest_s": longest}

    def summarize_row(self, row: Row) -> str:
        """Summarize the row for the progress line."""
        return f"{row['counts']}, {len(row['problems'])} wrong, grown by {row['grown_kib']} KiB"

    def report(self, rows: list[Row]) -> list[str]:
        """Report counts, wrong answers, memory and time."""
        counts = sum((Counter(row["counts"]) for row in rows), Counter[str]())
        total = counts["accepted"] + sum(count for name, count in counts.items() if name.startswith("refused"))
        problems = [problem for row in rows for problem in row["problems"]]
        spent, grown = sum(row["seconds"] for row in rows), max(row["grown_kib"] for row in rows)
        return [
            f"**{total:,}** observations, **{len(problems)}** wrong answers. Largest growth of a process within "
            f"{OBSERVATIONS_PER_UNIT:,} observations: {grown:,} KiB. Processor time of an observation and a step: "
            f"{1e6 * spent / max(total, 1):.0f} µs on average, at most "
            f"{1e3 * max(row['longest_s'] for row in rows):.1f} ms.",
            "",
            *markdown_table(
                ("result", "observations", "share"),
                [(name, f"{count:,}", f"{count / max(total, 1):.2%}") for name, count in counts.most_common()],
            ),
            *(f"- {problem}" for problem in problems[:20]),
        ]


def _observe(safety: SafetyFilter, rng: np.random.Generator) -> str:
    """Pass a fuzzed table to the filter: "accepted", or the class of the refusal."""
    n = int(rng.integers(0, MAX_OBSTACLES_AT_ONCE + 1))
    try:
        safety.observe([_obstacle(rng, f"o{k}") for k in range(n)], stamp=_number(rng, 0.0))
    except DualbrainError as error:
        return f"refused: {type(error).__name__}"
    except Exception as error:
        return f"raised: {type(error).__name__}"
    return "accepted"


def _obstacle(rng: np.random.Generator, name: str) -> Obstacle:
    size = [_number(rng, 0.05) for _ in range(3)]
    shapes = (
        lambda: Sphere(size[0]),
        lambda: Box((size[0], size[1], size[2])),
        lambda: Capsule(size[0], size[1]),
        lambda: Cylinder(size[0], size[1]),
        HalfSpace,
    )
    quaternion = tuple(_number(rng, value) for value in (1.0, 0.0, 0.0, 0.0))
    position = tuple(_number(rng, float(value)) for value in rng.uniform(-1.0, 1.0, 3))
    return Obstacle(
        name,
        shapes[int(rng.integers(len(shapes)))](),
        Pose(position, quaternion if rng.random() < 0.3 else (1.0, 0.0, 0.0, 0.0)),
        velocity=tuple(_number(rng, 0.0) for _ in range(3)) if rng.random() < 0.3 else (0.0, 0.0, 0.0),
        margin=_number(rng, 0.01) if rng.random() < 0.3 else 0.0,
        velocity_error=_number(rng, 0.0) if rng.random() < 0.3 else 0.0,
        static=bool(rng.random() < 0.5),
    )


def _number(rng: np.random.Generator, plausible: float) -> float:
    chance = rng.random()
    if chance < PLAUSIBLE_SHARE:
        return plausible
    if chance < PLAUSIBLE_SHARE + 0.2:
        return SPECIAL_VALUES[int(rng.integers(len(SPECIAL_VALUES)))]
    return float(np.frombuffer(rng.bytes(8), np.float64)[0])


def _problem(outcome: str, status: FilterStatus, u: np.ndarray[Any, Any], limits: list[float]) -> str:
    """The problem with a step after an observation, or ""."""
    if outcome.startswith("raised"):
        return outcome
    if outcome.startswith("refused") and status is not FilterStatus.STOPPED:
        return f"{outcome}, but the step was {status.name}"
    if not np.isfinite(u).all() or np.any(np.abs(u) > np.array(limits) * (1.0 + 1e-6)):
        return f"the control {u.tolist()} is not within the limits"
    return ""
