"""Three rounds of proposing, executing, curating and training from the base; only the adapted model proposes.

Every round is measured on the same held-out requests: the planner of the round answers each once, greedily and without
constraints, and the contracts that the gate accepts are executed with the filter on. Between measurements it proposes
contracts for other instructions and scenes at a temperature. The adapter of the next round is trained on the proposals
of all rounds so far that succeeded according to the robot and with little intervention. `round_chain.py` has the steps.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from dualbrain.evaluation.analysis.statistics import Clusters, Estimate, compare, difference, estimate
from experiments.adaptation.round_chain import BASE, N_INSTRUCTIONS, N_PLACES, TEMPERATURE, RoundChain
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_proportion, markdown_table

SEEDS, N_ROUNDS = range(1), 3
"""Chains, which differ in their instructions; number of rounds after the base."""


@dataclass(frozen=True)
class Metric:
    """A metric: the mean of `value` over the episodes to which it `applies`; a share is printed in percent."""

    value: Callable[[Row], float]
    applies: Callable[[Row], bool]
    is_share: bool = False
    digits: int = 4


def any_episode(one: Row) -> bool:
    """True for every episode."""
    return True


def has_motion(one: Row) -> bool:
    """Whether a control was executed."""
    return one["Delta"] is not None


METRICS: dict[str, Metric] = {
    "compliant": Metric(lambda one: one["compliant"], any_episode, is_share=True),
    "correct": Metric(lambda one: one["right"], any_episode, is_share=True),
    "success": Metric(lambda one: one["success"], any_episode, is_share=True),
    "declined if required": Metric(
        lambda one: one["outcome"] == "declined", lambda one: one["to_decline"], is_share=True
    ),
    "Δ of successes": Metric(lambda one: one["Delta"], lambda one: one["success"] and has_motion(one)),
    "intervention frequency": Metric(lambda one: one["frequency"], has_motion, digits=3),
    "time to completion [s]": Metric(
        lambda one: one["completion_s"], lambda one: one["success"] and has_motion(one), digits=1
    ),
}
"""The metrics of the evaluation: Δ and time refer to successful episodes."""


class Rounds:
    """The planner adapts to its robot by its own proposals."""

    name = "rounds"
    claim = (
        f"{N_ROUNDS} rounds from {BASE}: in each, the model makes {N_INSTRUCTIONS} proposals for one goal at "
        f"temperature {TEMPERATURE:g}, each is executed once, and the next adapter is trained from the base on all "
        "good episodes so far. Before and after each round, compliance, success, Δ, intervention and time are measured "
        f"on the same {N_PLACES} held-out requests (one chain: the randomness of proposals and training is not in the "
        "intervals)."
    )
    intervals = "bootstrap over requests, 95 %; for training samples Wilson, 95 %"

    def units(self, options: Options) -> list[WorkUnit]:
        """The base, then round by round every chain; the base is the same for all chains."""
        folder = str(options.folder / self.name)
        chains = [(0, 0)] + [(seed, number) for number in range(1, N_ROUNDS + 1) for seed in SEEDS]
        return [
            WorkUnit(f"chain {seed} round {number}", {"seed": seed, "round": number, "folder": folder})
            for seed, number in chains
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Run the rounds and training that this round needs, then measure."""
        chain, number = (
            RoundChain(parameters["seed"], Path(parameters["folder"]) / f"chain {parameters['seed']}"),
            parameters["round"],
        )
        row: Row = {"seed": parameters["seed"], "round": number}
        if number:
            row |= chain.training_summary(number)
        return row | {"episodes": chain.measure(number)}

    def summarize_row(self, row: Row) -> str:
        """The metrics."""
        return ", ".join(f"{name} {format_estimate(estimate_metric(name, [row]), METRICS[name])}" for name in METRICS)

    def report(self, rows: list[Row]) -> list[str]:
        """A line per round, differences to the base on the same requests, and the training data."""
        numbers = sorted({row["round"] for row in rows})
        by_round = {number: [row for row in rows if row["round"] == number] for number in numbers}
        lines = markdown_table(
            ("round", "chains", "episodes", *METRICS),
            (
                (
                    number,
                    len(some),
                    sum(len(row["episodes"]) for row in some),
                    *(format_estimate(estimate_metric(name, some), one) for name, one in METRICS.items()),
                )
                for number, some in by_round.items()
            ),
        )
        if 0 in by_round:
            lines += ["Differences to round 0 on the same requests (pairs):", ""]
            lines += markdown_table(
                ("round", *METRICS),
                (
                    (number, *(format_difference(name, by_round[0], some) for name in METRICS))
                    for number, some in by_round.items()
                    if number
                ),
            )
        return [*lines, *training_table(rows)]


def training_table(rows: Iterable[Row]) -> list[str]:
    """The training data of each adapter: samples, samples that follow their instruction, reasons for exclusion."""
    cells = [
        (
            row["seed"],
            row["round"],
            row["proposed"],
            row["samples"],
            format_proportion(row["as_said"], row["samples"]),
            f"{row['fit_s']:.0f}",
            row["adapter"][:16],
            "yes" if row["bootstrapped"] else "no",
            ", ".join(f"{number} {reason}" for reason, number in row["left_out"].items()),
        )
        for row in rows
        if row["round"]
    ]
    head = (
        "chain",
        "round",
        "proposals so far",
        "training samples",
        "follow the instruction",
        "training time [s]",
        "adapter",
        "bootstrapped",
        "left out",
    )
    return markdown_table(head, cells) if cells else []


def values_by_place(name: str, rows: Iterable[Row]) -> Clusters:
    """The values of a metric by held-out request."""
    metric, by_place = METRICS[name], dict[str, list[float]]()
    for one in (one for row in rows for one in row["episodes"] if metric.applies(one)):
        by_place.setdefault(one["id"], []).append(float(metric.value(one)))
    return by_place


def estimate_metric(name: str, rows: Iterable[Row]) -> Estimate:
    """Mean and 95 % interval of a metric; the bootstrap draws requests with the episodes of all chains."""
    return estimate(values_by_place(name, rows), is_rate=METRICS[name].is_share)


def format_estimate(found: Estimate, metric: Metric) -> str:
    """A mean with its interval."""
    as_text = partial(format_number, metric)
    return f"{as_text(found.mean)} ({as_text(found.low)} to {as_text(found.high)}), n = {found.n}" if found.n else "-"


def format_difference(name: str, base: list[Row], rows: list[Row]) -> str:
    """The mean difference of a metric to the base, over requests to which it applies in both."""
    metric = METRICS[name]
    found = compare(values_by_place(name, rows), values_by_place(name, base), difference)
    signed = partial(format_number, metric, sign="+")
    interval = f"({signed(found.low)} to {signed(found.high)})"
    return f"{signed(found.effect)} {interval}, {found.clusters}" if found.clusters else "-"


def format_number(metric: Metric, number: float, sign: str = "") -> str:
    """A number in the format of its metric."""
    return f"{number:{sign}.0%}" if metric.is_share else f"{number:{sign}.{metric.digits}f}"
