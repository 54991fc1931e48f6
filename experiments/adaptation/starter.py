"""The packaged planners and the large planner on held-out instructions, and the choice of the planner of the demo.

Each planner answers as it serves: an adapter with the short prompt that it was trained on, the large model with rules,
skills and worked examples. The grammar of the scene constrains every answer. Right answers are executed with the
filter. The planner of `make demo` is chosen among all packaged planners by one rule (`best_packaged_planner`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from functools import cache
from statistics import median
from typing import Any

from dualbrain.adaptation.adapters.packaged import packaged_names
from dualbrain.adaptation.curation.sample import Sample
from dualbrain.core import paths
from dualbrain.evaluation.analysis.statistics import compare, difference
from dualbrain.evaluation.planners.factory import PlannerSources
from dualbrain.planner.protocol import Planner, has_answer
from dualbrain.planner.registry import planner_names
from dualbrain.runtime.data_collection.rollouts import EPSILON, ROBOT, build_request
from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples
from experiments.adaptation.ablation_curve import execute_answer
from experiments.adaptation.no_answer import NoAnswerError
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_proportion, markdown_table
from experiments.planning.language import is_right, score_question

N_QUESTIONS, SEED = 60, 21
LARGE_PLANNER = "qwen2.5-coder-1.5b-instruct"
Answer = dict[str, Any]
"""Score of one answer, as the log stores it."""


class Starter:
    """The planner of the demo, chosen among all packaged planners."""

    name = "starter"
    claim = (
        f"{N_QUESTIONS} held-out instructions at a table (other sentences, scenes, a family and kinds of objects that "
        "no training example contained), each planner as it serves. The planner of `make demo` is the packaged planner "
        "with the most right answers; ties are decided by the executed answers that succeed, then by the decision time."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Each question for each available planner, question by question, so that any prefix compares equal cases."""
        del options
        available = [name for name in planners() if name in (*packaged_names(), *planner_names())]
        return [
            WorkUnit(f"question {number}, {name}", {"number": number, "who": name})
            for number in range(N_QUESTIONS)
            for name in available
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Request an answer, check it with the gate of the scene, and execute it if it is right."""
        return {**parameters, "answer": score_planner(parameters["who"], questions()[parameters["number"]])}

    def summarize_row(self, row: Row) -> str:
        """Whether the answer was right."""
        return "right" if is_right(row["answer"]) else "wrong"

    def report(self, rows: list[Row]) -> list[str]:
        """One row per planner, the right answers by kind of instruction, and the choice of the rule."""
        answers = {name: list(some.values()) for name, some in answers_by_planner(rows).items()}
        head = ("planner", "compliant", "right skills", "right", "these succeed", "with Δ ≤ ε", "median decision [s]")
        return [
            *markdown_table(head, ((name, *planner_row(some)) for name, some in answers.items())),
            *["Right answers by kind of instruction:", ""],
            *markdown_table(
                ("planner", *QUESTION_PARTS), ((name, *right_by_part(some)) for name, some in answers.items())
            ),
            *[rule_verdict(rows), ""],
        ]


def planners() -> tuple[str, ...]:
    """All packaged planners, and the large model for comparison."""
    return (*packaged_names(), LARGE_PLANNER)


def answers_by_planner(rows: Sequence[Row]) -> dict[str, dict[int, Answer]]:
    """Answers by planner and question; planners without answers are left out."""
    found = {name: {row["number"]: row["answer"] for row in rows if row["who"] == name} for name in planners()}
    return {name: some for name, some in found.items() if some}


def best_packaged_planner(rows: Sequence[Row]) -> str:
    """The planner of the demo: the packaged planner with the most right answers on common questions.

    Ties are decided by the number of executed answers that succeed, then by the median time per decision. Returns "" if
    a packaged planner has no answers, or if there is no common question.
    """
    answers = answers_by_planner(rows)
    if not all(name in answers for name in packaged_names()):
        return ""
    common = set.intersection(*(set(answers[name]) for name in packaged_names()))
    if not common:
        return ""
    return min(packaged_names(), key=lambda name: _rank([answers[name][number] for number in sorted(common)]))


def _rank(answers: Sequence[Answer]) -> tuple[int, int, float]:
    """Sort key of the rule: smaller is better."""
    n_right, n_succeeded = sum(map(is_right, answers)), sum(map(_succeeds, answers))
    return -n_right, -n_succeeded, median(one["decision_s"] for one in answers)


def _succeeds(answer: Answer) -> bool:
    return bool(answer["flight"]) and answer["flight"]["kind"] == "succeeded"


def rule_verdict(rows: Sequence[Row]) -> str:
    """The choice of the rule, and how it compares with the other planners on the same questions."""
    chosen = best_packaged_planner(rows)
    if not chosen:
        return "The packaged planners did not answer the same questions, so the rule has no result."
    answers = answers_by_planner(rows)
    differences = "; ".join(
        f"minus {name}: {_difference(answers[chosen], answers[name])}" for name in answers if name != chosen
    )
    return (
        f"By the rule **{chosen}** is the planner of `make demo`: most right answers of all packaged planners. Share "
        f"of right answers of {chosen} on the same questions, {differences}."
    )


def _difference(a: Mapping[int, Answer], b: Mapping[int, Answer]) -> str:
    sides = ({str(number): [float(is_right(one))] for number, one in some.items()} for some in (a, b))
    found = compare(*sides, difference)
    return f"{found.effect:+.0%} (95 % interval {found.low:+.0%} to {found.high:+.0%})"


QUESTION_PARTS: dict[str, Callable[[Answer], bool]] = {
    "one goal": lambda one: one["goals"] == 1 and not one["declines"],
    "two goals or more": lambda one: one["goals"] > 1,
    "to be declined": lambda one: one["declines"],
}
"""Kinds of instructions."""


def right_by_part(answers: Sequence[Answer]) -> list[str]:
    """Share of right answers for each kind of instruction."""
    parts = ([is_right(one) for one in answers if belongs(one)] for belongs in QUESTION_PARTS.values())
    return [format_proportion(sum(part), len(part)) for part in parts]


def planner_row(answers: Sequence[Answer]) -> list[str]:
    """Shares of all answers, then shares of the executed answers, then the median time of an answer."""
    counts = [sum(one[part] for one in answers) for part in ("compliant", "skills")] + [sum(map(is_right, answers))]
    executed = [one["flight"] for one in answers if one["flight"]]
    deltas = [one["Delta"] for one in executed if one["kind"] == "succeeded"]
    successes = [len(deltas), sum(Delta is not None and Delta <= EPSILON for Delta in deltas)]
    cells = [format_proportion(count, len(answers)) for count in counts]
    cells += [format_proportion(count, len(executed)) for count in successes]
    return [*cells, f"{median(one['decision_s'] for one in answers):.1f}"]


@cache
def questions() -> tuple[Sample, ...]:
    """The questions, always the same, without exemplars."""
    return generate_examples(N_QUESTIONS, "test", SEED, {ROBOT: 1.0}, exemplar_share=0.0)


@cache
def cached_planner(name: str) -> Planner:
    """The planner called `name` as it serves, opened once per process."""
    return PlannerSources(paths.cache_folder(), paths.dualbrain_home() / "adapters").open(name, ROBOT)


def score_planner(name: str, question: Sample) -> Answer:
    """Score of an answer, its time, and the result of its execution if it is right and moves something."""
    proposal = cached_planner(name).propose(build_request(question))
    if not has_answer(proposal):
        raise NoAnswerError(proposal.finish_reason)
    score = score_question(question, proposal.text)
    execution = execute_answer(score) if is_right(score) and not score["declines"] else None
    return {**score, "bound": proposal.constrained_by, "decision_s": proposal.timings["total"], "flight": execution}
