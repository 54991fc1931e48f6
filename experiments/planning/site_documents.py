"""Passages from documents of the operator alone: whether they help the planner that reads them, without harm.

Packaged documents made the planner decline instructions that it carries out without them (experiment `documents`). Here
only a site document is read. It states a rule for each of three objects of the scene, and general rules of the place.
New questions: placements in which one of the rules counts, and other instructions in scenes with such a document.
"""

from __future__ import annotations

from collections.abc import Sequence
from functools import cache
from typing import Any

from dualbrain.adaptation.curation.sample import Sample
from dualbrain.planner.protocol import has_answer
from dualbrain.records import RetrievedContext
from dualbrain.runtime.data_collection.rollouts import build_request
from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples, scene_context_by_name
from experiments.adaptation.no_answer import NoAnswerError
from experiments.adaptation.starter import LARGE_PLANNER, cached_planner
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.planning.documents import (
    ROBOT,
    RULES,
    decline_table,
    find_passages,
    follows,
    is_declined,
    kind_table,
    paired_difference,
    paired_units,
    part_table,
    reference,
    rule_of,
    words,
)
from experiments.planning.language import is_right, score_question

N_RULES, N_OTHERS = 24, 12
RULE_SEED, OTHER_SEED = 36, 37
MAX_MORE_DECLINES, LEAST_DIFFERENCE = 1, -0.05
GENERAL_RULES = (
    "## Working hours\n\nThe table is in use from 8 to 17 o'clock. The operator is at the desk in the hall.\n",
    "## Order\n\nNothing is left on the floor. Cups, blocks and tools go back to their places in the evening.\n",
    "## Visitors\n\nVisitors stay behind the yellow line. The operator stops the robot before a visitor crosses it.\n",
)


class SiteDocuments:
    """The large planner with and without passages of a document of the operator."""

    name = "site_documents"
    claim = (
        f"With passages of the operator's documents alone, the contract of {LARGE_PLANNER} has a parameter that only "
        "the document states more often than without (interval above 0), of all "
        f"{N_RULES + N_OTHERS} instructions at most {MAX_MORE_DECLINES} more is declined, and the share of right "
        f"answers is at most {-100 * LEAST_DIFFERENCE:.0f} points lower. If all three hold, these passages are on by "
        "default."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Each question with and without passages, question by question, so that any prefix compares equal cases."""
        del options
        return paired_units({"rule": N_RULES, "other": N_OTHERS})

    def run(self, parameters: dict[str, Any]) -> Row:
        """Ask the planner once; score the contract, and the rule of the document."""
        part, number = parameters["part"], parameters["number"]
        question = rule_questions()[number] if part == "rule" else other_questions()[number]
        document = site_document(number, question)
        passages = find_passages(question, document, "site") if parameters["reading"] == "with" else ()
        proposal = cached_planner(LARGE_PLANNER).propose(build_request(question, RetrievedContext(passages=passages)))
        if not has_answer(proposal):
            raise NoAnswerError(proposal.finish_reason)
        row = {
            **parameters,
            "answer": score_question(question, proposal.text),
            "passages": [one.text for one in passages],
            "decision_s": proposal.timings["total"],
        }
        if part == "rule":
            name, kind = rule_of(number)
            sentence = kind.sentence.format(object=words(ruled_objects(question)[0]), value=kind.values[0])
            row |= {"rule": name, "found": any(sentence in one.text for one in passages)}
            row["follows"] = follows(proposal.text, kind)
        return row

    def summarize_row(self, row: Row) -> str:
        """Whether the answer was right, declined, and followed the rule."""
        answer = "declined" if is_declined(row["answer"]["text"]) else "right" if is_right(row["answer"]) else "wrong"
        rule = "" if row["part"] == "other" else ", follows the rule" if row["follows"] else ", ignores the rule"
        return f"{answer}{rule}, {len(row['passages'])} passages"

    def report(self, rows: list[Row]) -> list[str]:
        """Both parts, the paired differences, and the declines."""
        rules = [row for row in rows if row["part"] == "rule"]
        followed, right = "right and as the document states", "right"
        return [
            "Placements with a rule:",
            "",
            *part_table(rules, followed, _right_and_followed),
            paired_difference(rules, followed, _right_and_followed),
            "",
            "All instructions:",
            "",
            *part_table(rows, right, _right),
            paired_difference(rows, right, _right),
            "",
            *decline_table(rows),
            "",
            *kind_table(rules),
        ]


def _right(row: Row) -> bool:
    return is_right(row["answer"])


def _right_and_followed(row: Row) -> bool:
    return is_right(row["answer"]) and bool(row["follows"])


@cache
def rule_questions() -> tuple[Sample, ...]:
    """Held-out instructions that put one object somewhere, without exemplars, in scenes with three objects or more."""
    drawn = generate_examples(8 * N_RULES, "test", RULE_SEED, {ROBOT: 1.0}, exemplar_share=0.0)
    placements = [one for one in drawn if [action.skill for action in reference(one)] == ["grasp", "place"]]
    return _first([one for one in placements if len(graspable(one)) >= len(RULES)], N_RULES)


@cache
def other_questions() -> tuple[Sample, ...]:
    """Other held-out instructions, without exemplars, in scenes with three objects or more."""
    drawn = generate_examples(6 * N_OTHERS, "test", OTHER_SEED, {ROBOT: 1.0}, exemplar_share=0.0)
    others = [one for one in drawn if [action.skill for action in reference(one)] != ["grasp", "place"]]
    return _first([one for one in others if len(graspable(one)) >= len(RULES)], N_OTHERS)


def _first(found: Sequence[Sample], count: int) -> tuple[Sample, ...]:
    assert len(found) >= count
    return tuple(found[:count])


def graspable(question: Sample) -> tuple[str, ...]:
    """The graspable objects of the scene of a question."""
    return tuple(scene_context_by_name(question.scene).names.graspable)


def ruled_objects(question: Sample) -> list[str]:
    """Three objects with a rule: that of the instruction first, if its contract grasps one."""
    grasped = [str(action.params["object"]) for action in reference(question) if "object" in action.params]
    asked = [name for name in grasped if name in graspable(question)][:1]
    return [*asked, *(name for name in graspable(question) if name not in asked)][: len(RULES)]


def site_document(number: int, question: Sample) -> str:
    """A site document in Markdown: the rules of three objects, that of the instruction second, among general rules."""
    _, kind = rule_of(number)
    first, second, third = ruled_objects(question)
    sections = [
        f"## Handling of the {words(name)}\n\n{kind.sentence.format(object=words(name), value=value)}\n"
        for name, value in ((second, kind.values[1]), (first, kind.values[0]), (third, kind.values[2]))
    ]
    return "\n".join(("# Rules of this table\n", GENERAL_RULES[0], *sections, *GENERAL_RULES[1:]))
