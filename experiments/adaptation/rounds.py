"""rounds: propose, execute, curate, fit from the base, three times, and nobody but the adapted model ever proposes.

Every round is measured on the same held-out places: the planner of the round answers freely and greedily, once, and
what the gate accepts is carried out with the filter on. Between, it is asked other things in other words and scenes, at
a temperature; what went well by the robot's own verdict and with little Δ, of this round and all before, is what the
adapter of the next round is taught. `chain` has the steps.
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
"""Chains that begin with other instructions; rounds after the base."""
PLOT_PATH = "images/rounds.png"


@dataclass(frozen=True)
class Metric:
    """What is told of an episode: the mean over those that it `counts` of a `number`; a share is written in percent."""

    value: Callable[[Row], float]
    applies: Callable[[Row], bool]
    is_share: bool = False
    digits: int = 4


def any_episode(one: Row) -> bool:
    """Every episode."""
    return True


def has_motion(one: Row) -> bool:
    """Some control was executed."""
    return one["Delta"] is not None


METRICS: dict[str, Metric] = {
    "compliant": Metric(lambda one: one["compliant"], any_episode, is_share=True),
    "right": Metric(lambda one: one["right"], any_episode, is_share=True),
    "success": Metric(lambda one: one["success"], any_episode, is_share=True),
    "declined what must be": Metric(
        lambda one: one["outcome"] == "declined", lambda one: one["to_decline"], is_share=True
    ),
    "Δ of successes": Metric(lambda one: one["Delta"], lambda one: one["success"] and has_motion(one)),
    "intervention frequency": Metric(lambda one: one["frequency"], has_motion, digits=3),
    "time to completion [s]": Metric(
        lambda one: one["completion_s"], lambda one: one["success"] and has_motion(one), digits=1
    ),
}
"""As docs/reference/evaluation.md has them: Δ and time count where it succeeded."""


class Rounds:
    """The planner learns its body from what it proposed itself."""

    name = "rounds"
    claim = (
        f"{N_ROUNDS} rounds from {BASE}: {N_INSTRUCTIONS} proposals of the model itself at temperature {TEMPERATURE:g}, one goal "
        "each, each "
        "carried out once, then fitted from the base on all that went well so far (one chain: the chance in "
        "proposals and fits is not in the intervals); before and after each, the same "
        f"{N_PLACES} held-out places: compliance, success, Δ, intervention, time."
    )
    intervals = "bootstrap over places, of samples Wilson, 95 %"

    def units(self, options: Options) -> list[WorkUnit]:
        """The base, then round by round every chain; of the base all chains have the same."""
        folder = str(options.folder / self.name)
        told = [(0, 0)] + [(seed, number) for number in range(1, N_ROUNDS + 1) for seed in SEEDS]
        return [
            WorkUnit(f"chain {seed} round {number}", {"seed": seed, "round": number, "folder": folder})
            for seed, number in told
        ]

    def run(self, about: dict[str, Any]) -> Row:
        """Live and fit as far as the round needs it, then measure."""
        chain, number = RoundChain(about["seed"], Path(about["folder"]) / f"chain {about['seed']}"), about["round"]
        row: Row = {"seed": about["seed"], "round": number}
        if number:
            row |= chain.training_summary(number)
        return row | {"episodes": chain.measure(number)}

    def summarize_row(self, row: Row) -> str:
        """The measures."""
        return ", ".join(f"{name} {format_estimate(estimate_metric(name, [row]), METRICS[name])}" for name in METRICS)

    def report(self, rows: list[Row]) -> list[str]:
        """A line a round; differences to the base at the same places; what was taught."""
        numbers = sorted({row["round"] for row in rows})
        by_round = {number: [row for row in rows if row["round"] == number] for number in numbers}
        lines = markdown_table(
            ("round", "chains", "episodes", *METRICS),
            (
                (
                    number,
                    len(mine),
                    sum(len(row["episodes"]) for row in mine),
                    *(format_estimate(estimate_metric(name, mine), one) for name, one in METRICS.items()),
                )
                for number, mine in by_round.items()
            ),
        )
        if 0 in by_round:
            lines += ["Differences to round 0 at the same places (pairs):", ""]
            lines += markdown_table(
                ("round", *METRICS),
                (
                    (number, *(format_difference(name, by_round[0], mine) for name in METRICS))
                    for number, mine in by_round.items()
                    if number
                ),
            )
        return [*lines, *training_table(rows), f"![Measures by round]({PLOT_PATH})", ""]


def training_table(rows: Iterable[Row]) -> list[str]:
    """What each adapter was taught: how many samples, how many of them do as they were told, and why not others."""
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
        "proposed so far",
        "samples taught",
        "as the words said",
        "fit [s]",
        "adapter",
        "bootstrapped",
        "left out",
    )
    return markdown_table(head, cells) if cells else []


def values_by_place(name: str, rows: Iterable[Row]) -> Clusters:
    """The numbers of a measure by place."""
    measure, by_place = METRICS[name], dict[str, list[float]]()
    for one in (one for row in rows for one in row["episodes"] if measure.applies(one)):
        by_place.setdefault(one["id"], []).append(float(measure.value(one)))
    return by_place


def estimate_metric(name: str, rows: Iterable[Row]) -> Estimate:
    """Mean and 95 % interval of a measure; places are drawn, with all that the chains did there."""
    return estimate(values_by_place(name, rows), is_rate=METRICS[name].is_share)


def format_estimate(told: Estimate, measure: Metric) -> str:
    """A mean with its interval."""
    as_text = partial(format_number, measure)
    return f"{as_text(told.mean)} ({as_text(told.low)} to {as_text(told.high)}), n = {told.n}" if told.n else "-"


def format_difference(name: str, base: list[Row], rows: list[Row]) -> str:
    """The mean difference of a measure to the base, where it counts at the same place in both."""
    measure = METRICS[name]
    told = compare(values_by_place(name, rows), values_by_place(name, base), difference)
    signed = partial(format_number, measure, sign="+")
    return (
        f"{signed(told.effect)} ({signed(told.low)} to {signed(told.high)}), {told.clusters}" if told.clusters else "-"
    )


def format_number(measure: Metric, number: float, sign: str = "") -> str:
    """A number as the table has it."""
    return f"{number:{sign}.0%}" if measure.is_share else f"{number:{sign}.{measure.digits}f}"
