"""starter: the small planner that a robot taught on its first night, beside the planner eleven times its size.

Both are asked as they serve, the one by the short prompt it was taught, the other by rules, skills and worked examples,
each bound by the grammar of the scene. What is right is carried out with the filter on. The rule by which the small one
becomes the planner of `make demo` stood before either was asked: it is right at least as often.
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
from experiments.planning.language import is_right, score_answer

N_QUESTIONS, SEED = 60, 21
SMALL_PLANNER, LARGE_PLANNER = "starter-135m", "qwen2.5-coder-1.5b-instruct"
PLANNERS = (SMALL_PLANNER, "base-135m", LARGE_PLANNER)
"""Who is asked; the base of the tables knows the language of contracts, and nothing of any body."""


class Starter:
    """Whether the first planner can be the small one."""

    name = "starter"
    claim = (
        f"{N_QUESTIONS} held-out instructions at a table (other sentences, scenes, a family and kinds of things that no "
        f"lesson held), each planner as it serves. By a rule that stood before, {SMALL_PLANNER} becomes the planner of "
        f"`make demo` if it is right at least as often as {LARGE_PLANNER}."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Question by question, to everybody that dualbrain comes with: any prefix compares at like places."""
        del options
        asked = [name for name in PLANNERS if name in (*packaged_names(), *planner_names())]
        return [
            WorkUnit(f"question {number}, {who}", {"number": number, "who": who})
            for number in range(N_QUESTIONS)
            for who in asked
        ]

    def run(self, about: dict[str, Any]) -> Row:
        """Ask, judge the answer by the gate of the scene, carry it out if it is right."""
        return {**about, "answer": score_planner(about["who"], questions()[about["number"]])}

    def summarize_row(self, row: Row) -> str:
        """Whether it was right."""
        return "right" if is_right(row["answer"]) else "wrong"

    def report(self, rows: list[Row]) -> list[str]:
        """A line a planner, and the difference at the same questions."""
        answers = {who: [row["answer"] for row in rows if row["who"] == who] for who in PLANNERS}
        asked = {who: mine for who, mine in answers.items() if mine}
        head = ("planner", "compliant", "right skills", "right", "these succeed", "with Δ ≤ ε", "median decision [s]")
        return [
            *markdown_table(head, ((who, *planner_row(mine)) for who, mine in asked.items())),
            *["Right, by what is asked:", ""],
            *markdown_table(("planner", *QUESTION_PARTS), ((who, *right_by_part(mine)) for who, mine in asked.items())),
            *[comparison_verdict(rows), ""],
        ]


QUESTION_PARTS: dict[str, Callable[[dict[str, Any]], bool]] = {
    "one goal": lambda one: one["goals"] == 1 and not one["declines"],
    "two goals or more": lambda one: one["goals"] > 1,
    "to be declined": lambda one: one["declines"],
}
"""What is asked for."""


def right_by_part(answers: list[dict[str, Any]]) -> list[str]:
    """How many are right of each part."""
    some = ([is_right(one) for one in answers if belongs(one)] for belongs in QUESTION_PARTS.values())
    return [format_proportion(sum(one), len(one)) for one in some]


def planner_row(answers: list[dict[str, Any]]) -> list[str]:
    """Shares of all answers, then of the flights of those that are right, then the time that an answer takes."""
    of_answers = [sum(one[what] for one in answers) for what in ("compliant", "skills")] + [sum(map(is_right, answers))]
    flights = [one["flight"] for one in answers if one["flight"]]
    done = [one["Delta"] for one in flights if one["kind"] == "succeeded"]
    of_flights = [len(done), sum(Delta is not None and Delta <= EPSILON for Delta in done)]
    told = [format_proportion(count, len(answers)) for count in of_answers]
    told += [format_proportion(count, len(flights)) for count in of_flights]
    return [*told, f"{median(one['decision_s'] for one in answers):.1f}"]


def comparison_verdict(rows: list[Row]) -> str:
    """The rule, and its answer; nothing is answered before both were asked the same."""
    small, large = (
        {str(row["number"]): [float(is_right(row["answer"]))] for row in rows if row["who"] == who}
        for who in (SMALL_PLANNER, LARGE_PLANNER)
    )
    if not small.keys() & large.keys():
        return f"{SMALL_PLANNER} and {LARGE_PLANNER} were not both asked, so the rule has no answer."
    told = compare(small, large, difference)
    words = "is" if told.effect >= 0.0 else "is not"
    return (
        f"Right, {SMALL_PLANNER} less {LARGE_PLANNER}, at the same questions: {told.effect:+.0%} (95 % interval {told.low:+.0%} to "
        f"{told.high:+.0%}); by the rule {SMALL_PLANNER} {words} the planner of `make demo`."
    )


@cache
def questions() -> tuple[Sample, ...]:
    """The questions, always the same, without exemplars."""
    return generate_examples(N_QUESTIONS, "test", SEED, {ROBOT: 1.0}, exemplar_share=0.0)


@cache
def cached_planner(name: str) -> Planner:
    """The planner called `name` as it serves, opened once a process."""
    return PlannerSources(paths.cache_folder(), paths.dualbrain_home() / "adapters").open(name, ROBOT)


def score_planner(name: str, question: Sample) -> dict[str, Any]:
    """The score of an answer, how long it took, and what became of it where it is right and something moves."""
    said = cached_planner(name).propose(build_request(question))
    if not has_answer(said):
        raise NoAnswerError(said.finish_reason)
    told = score_answer(question, said.text)
    deed = execute_answer(told) if is_right(told) and not told["declines"] else None
    return {**told, "bound": said.constrained_by, "decision_s": said.timings["total"], "flight": deed}
