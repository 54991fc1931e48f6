"""The small starter planner, trained from a robot's first data, compared with a planner eleven times its size.

Both are measured as they serve: the small one with the short prompt of its training, the large one with rules, skills
and worked examples, both with the grammar of the scene. Correct contracts are executed with the filter on. The rule
that makes the small one the planner of `make demo` was fixed before: it is correct at least as often.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import cache
from statistics import median
from typing import Any

from dualbrain.adaptation.adapters.packaged import packaged_names
from dualbrain.adaptation.curation.sample import Sample
from dualbrain.cli.common import paths
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
SMALL_PLANNER, LARGE_PLANNER = "starter-135m", "qwen2.5-coder-1.5b-instruct"
PLANNERS = (SMALL_PLANNER, "base-135m", LARGE_PLANNER)
"""The compared planners; base-135m is trained on contracts without data of any robot."""


class Starter:
    """The small planner as the default planner of the demo."""

    name = "starter"
    claim = (
        f"{N_QUESTIONS} held-out instructions at a table (sentences, scenes, a family and kinds of objects outside the "
        f"training data), each planner as it serves. By a rule fixed beforehand, {SMALL_PLANNER} becomes the planner "
        f"of `make demo` if it is correct at least as often as {LARGE_PLANNER}."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Request by request, for every installed planner, so that any prefix compares them on the same requests."""
        del options
        known = [name for name in PLANNERS if name in (*packaged_names(), *planner_names())]
        return [
            WorkUnit(f"question {number}, {planner}", {"number": number, "who": planner})
            for number in range(N_QUESTIONS)
            for planner in known
        ]

    def run(self, about: dict[str, Any]) -> Row:
        """Plan, judge the answer by the gate of the scene, execute it if it is correct."""
        return {**about, "answer": score_planner(about["who"], questions()[about["number"]])}

    def summarize_row(self, row: Row) -> str:
        """Whether the answer was correct."""
        return "correct" if is_right(row["answer"]) else "wrong"

    def report(self, rows: list[Row]) -> list[str]:
        """A line per planner, and the difference on the same requests."""
        by_planner = {name: [row["answer"] for row in rows if row["who"] == name] for name in PLANNERS}
        answers = {name: some for name, some in by_planner.items() if some}
        head = (
            "planner",
            "compliant",
            "correct skills",
            "correct",
            "executed with success",
            "with Δ ≤ ε",
            "median decision [s]",
        )
        parts = ("planner", *QUESTION_PARTS)
        return [
            *markdown_table(head, ((name, *planner_row(some)) for name, some in answers.items())),
            *["Correct answers by type of request:", ""],
            *markdown_table(parts, ((name, *right_by_part(some)) for name, some in answers.items())),
            *[comparison_verdict(rows), ""],
        ]


QUESTION_PARTS: dict[str, Callable[[dict[str, Any]], bool]] = {
    "one goal": lambda one: one["goals"] == 1 and not one["declines"],
    "two goals or more": lambda one: one["goals"] > 1,
    "to be declined": lambda one: one["declines"],
}
"""Types of requests."""


def right_by_part(answers: list[dict[str, Any]]) -> list[str]:
    """The correct answers of each type of request."""
    some = ([is_right(one) for one in answers if belongs(one)] for belongs in QUESTION_PARTS.values())
    return [format_proportion(sum(one), len(one)) for one in some]


def planner_row(answers: list[dict[str, Any]]) -> list[str]:
    """Shares of all answers, shares of the executed ones, and the median planning time [s]."""
    counts = [sum(one[score] for one in answers) for score in ("compliant", "skills")] + [sum(map(is_right, answers))]
    executed = [one["flight"] for one in answers if one["flight"]]
    deltas = [one["Delta"] for one in executed if one["kind"] == "succeeded"]
    executed_counts = [len(deltas), sum(Delta is not None and Delta <= EPSILON for Delta in deltas)]
    cells = [format_proportion(count, len(answers)) for count in counts]
    cells += [format_proportion(count, len(executed)) for count in executed_counts]
    return [*cells, f"{median(one['decision_s'] for one in answers):.1f}"]


def comparison_verdict(rows: list[Row]) -> str:
    """The result of the rule, once both planners have answered the same requests."""
    small, large = (
        {str(row["number"]): [float(is_right(row["answer"]))] for row in rows if row["who"] == name}
        for name in (SMALL_PLANNER, LARGE_PLANNER)
    )
    if not small.keys() & large.keys():
        return f"{SMALL_PLANNER} and {LARGE_PLANNER} have no common request, so the rule cannot be applied."
    found = compare(small, large, difference)
    verb = "is" if found.effect >= 0.0 else "is not"
    return (
        f"Difference in correct answers, {SMALL_PLANNER} minus {LARGE_PLANNER}, on the same requests: "
        f"{found.effect:+.0%} (95 % interval {found.low:+.0%} to {found.high:+.0%}). By the rule, {SMALL_PLANNER} "
        f"{verb} the planner of `make demo`."
    )


@cache
def questions() -> tuple[Sample, ...]:
    """The requests, always the same, without exemplars."""
    return generate_examples(N_QUESTIONS, "test", SEED, {ROBOT: 1.0}, exemplar_share=0.0)


@cache
def cached_planner(name: str) -> Planner:
    """The planner called `name` as it serves, opened once per process."""
    return PlannerSources(paths.cache_folder(), paths.dualbrain_home() / "adapters").open(name, ROBOT)


def score_planner(name: str, question: Sample) -> dict[str, Any]:
    """The score of an answer, its planning time, and the outcome of its execution if it is correct and moves."""
    proposal = cached_planner(name).propose(build_request(question))
    if not has_answer(proposal):
        raise NoAnswerError(proposal.finish_reason)
    score = score_question(question, proposal.text)
    outcome = execute_answer(score) if is_right(score) and not score["declines"] else None
    return {
        **score,
        "bound": proposal.constrained_by,
        "decision_s": proposal.timings["total"],
        "flight": outcome,
    }
