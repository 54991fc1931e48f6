"""Limits of the speed of all parts and of the jerk of the joints in at least 1e7 worst-case steps."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.safety.speed_limits.classes import CLASSES, COMPLETE_CLASSES, NEGATIVE_CONTROLS, SpeedClass
from experiments.safety.speed_limits.judge import Judge
from experiments.safety.speed_limits.tables import speed_tables
from experiments.safety.speed_limits.trial import STATUSES, make_trial

EPISODES_PER_UNIT, STEPS_PER_EPISODE = 10, 10_000
BLOCKS, CONTROL_BLOCKS = 11, 2
AVOIDABLE = 0.996
"""Least possible share of the limits below which a step above them counts as avoidable; the filter needs the rest."""
SUMMED = ("steps", "above", "unreported", "avoidable", "jerks", "used", "near", *STATUSES)


class SpeedLimits:
    """Limits of speed and jerk against an adversary, by a judge in float64 that shares no code with the filter."""

    name = "speed_limits"
    claim = (
        "In at least 1e7 adversarial steps of Panda and UR5e, also while the arm evades an obstacle, no part, also of "
        "a grasped object, is faster than the limit of the filter or, near a person, of the site, unless the filter "
        "reports that it found no control that keeps the limit (OVERSPEED); no joint exceeds its jerk limit; each "
        "negative control fails."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Blocks of every class, then of the negative controls."""
        del options
        kinds = [(kind, block) for block in range(BLOCKS) for kind in COMPLETE_CLASSES]
        kinds += [(kind, block) for block in range(CONTROL_BLOCKS) for kind in NEGATIVE_CONTROLS]
        return [WorkUnit(f"{kind.name} {block}", {"class": kind.name, "block": block}) for kind, block in kinds]

    def run(self, parameters: dict[str, Any]) -> Row:
        """`EPISODES_PER_UNIT` random scenes of `STEPS_PER_EPISODE` steps each."""
        first = parameters["block"] * EPISODES_PER_UNIT
        seeds = range(first, first + EPISODES_PER_UNIT)
        return {**parameters, **aggregate(run_episode(CLASSES[parameters["class"]], seed) for seed in seeds)}

    def summarize_row(self, row: Row) -> str:
        """The steps above the limit, and the largest share of it."""
        above = f"above on {row['above']} of {row['steps']} steps, at most {row['largest']:.4f} of the limit"
        return f"{above}; {row['unreported']} unreported, {row['avoidable']} avoidable"

    def report(self, rows: list[Row]) -> list[str]:
        """The verdict, the classes, and the negative controls."""
        totals = {
            name: aggregate(group) for name in CLASSES if (group := [one for one in rows if one["class"] == name])
        }
        return speed_tables(totals)


def run_episode(kind: SpeedClass, seed: int, steps: int = STEPS_PER_EPISODE) -> Row:
    """The counts of one random scene and start posture."""
    trial, judge = make_trial(kind, seed), Judge(kind)
    q, u, counts = trial.run(steps)
    above, row = judge.judge(q, u, trial.person)
    examined = [] if kind.compared_with else above
    return (
        row
        | counts
        | {
            "unreported": sum(not trial.reports_overspeed(step) for step in examined),
            "avoidable": sum(judge.least_share(q, u, trial.person, step) < AVOIDABLE for step in examined),
        }
    )


def aggregate(counts: Iterable[Row]) -> Row:
    """Sums and maxima of the counts of several episodes."""
    group = list(counts)
    sums = {name: sum(one[name] for one in group) for name in SUMMED}
    return sums | {name: max(one[name] for one in group) for name in ("largest", "jerk")}
