"""Parameters that only a document states: whether a planner that reads passages follows them, and what reading costs.

A site document states one rule for each of three objects of a scene, with values that no planner chooses by itself; the
rule of one of them counts. The same instruction is asked with and without passages. Other instructions, to which no
document contributes anything, are asked with and without the passages that search finds in the packaged documents.

The same rules as limits of the site file are asked, too, of this planner and of a packaged one, which reads no
documents.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any

import msgspec

from dualbrain.adaptation.curation.sample import Sample
from dualbrain.contracts.contract import Action, Contract
from dualbrain.contracts.schema import DECLINE
from dualbrain.core import paths
from dualbrain.errors import DECODE_ERRORS
from dualbrain.evaluation.analysis.statistics import compare, difference
from dualbrain.grounding.document_retrieval import Budget, retrieve_passages
from dualbrain.grounding.envelope.object_limits import with_object_limits
from dualbrain.knowledge.builtin_documents import add_builtin_documents
from dualbrain.knowledge.document import TrustLevel
from dualbrain.knowledge.library import Library, Submission
from dualbrain.memory.embedding.text_encoder import MiniLmEncoder
from dualbrain.planner.protocol import has_answer
from dualbrain.planner.registry import PACKAGED_PLANNER
from dualbrain.records import ObjectLimits, Passage, RetrievedContext
from dualbrain.runtime.data_collection.rollouts import build_request, instruction_of
from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples, scene_context_by_name
from dualbrain.runtime.planning.planner_request import answer_schema
from experiments.adaptation.no_answer import NoAnswerError
from experiments.adaptation.starter import LARGE_PLANNER, cached_planner
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_proportion, markdown_table
from experiments.planning.language import is_right, score_question

N_RULES, N_OTHERS = 24, 40
RULE_SEED, OTHER_SEED = 34, 35
ROBOT = "panda"


@dataclass(frozen=True, slots=True)
class RuleKind:
    """A kind of rule: its sentence for an object and a value, the values of three objects, and its check."""

    sentence: str
    values: tuple[float, float, float]
    holds: Callable[[Action, float], bool]


RULES: Mapping[str, RuleKind] = {
    "speed": RuleKind(
        "The {object} must not be moved faster than {value} m/s.",
        (0.08, 0.12, 0.35),
        lambda action, value: float(action.params["speed"]) <= value,
    ),
    "force": RuleKind(
        "The {object} must be gripped with at most {value} N.",
        (8.0, 12.0, 40.0),
        lambda action, value: float(action.params.get("force", 0.0)) <= value,
    ),
    "clearance": RuleKind(
        "The {object} must be carried with a clearance of at least {value} m.",
        (0.3, 0.25, 0.05),
        lambda action, value: action.skill != "place" or float(action.params["clearance"]) >= value,
    ),
}
"""The first of the three values is that of the object of the instruction."""


SITE_FILE = "site file"
READINGS = {LARGE_PLANNER: ("without", "with", SITE_FILE), PACKAGED_PLANNER: ("without", SITE_FILE)}
"""How each planner is asked for a rule: without it, with it in a passage, or with it as a limit of the site file."""


class Documents:
    """The large planner with and without passages of documents, and with the rules as limits of the site file."""

    name = "documents"
    claim = (
        f"In {N_RULES} instructions whose correct parameter only a document states, the contract of {LARGE_PLANNER} "
        f"has it more often with passages than without, and {N_OTHERS} other held-out instructions are answered right "
        "as often with passages as without (difference of at least -5 points). If both hold, passages are on by "
        "default for planners that read them."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Each question with and without passages, question by question, so that any prefix compares equal cases."""
        del options
        passages = paired_units({"rule": N_RULES, "other": N_OTHERS})
        limits = [
            WorkUnit(
                f"rule {number}, {reading}, {planner}",
                {"part": "rule", "number": number, "reading": reading, "planner": planner},
            )
            for number in range(N_RULES)
            for planner, readings in READINGS.items()
            for reading in readings
            if planner != LARGE_PLANNER or reading == SITE_FILE
        ]
        return [*passages, *limits]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Ask the planner once; score the contract, and the rule of the document."""
        part, number = parameters["part"], parameters["number"]
        question = rule_questions()[number] if part == "rule" else other_questions()[number]
        document = rule_document(number, question) if part == "rule" else ""
        passages = find_passages(question, document) if parameters["reading"] == "with" else ()
        request = build_request(question, RetrievedContext(passages=passages))
        if parameters["reading"] == SITE_FILE:
            request = msgspec.structs.replace(request, schema=limited_schema(number, question))
        proposal = cached_planner(parameters.get("planner", LARGE_PLANNER)).propose(request)
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
            row |= {"rule": name, "found": any(rule_sentence(number, question) in one.text for one in passages)}
            row["follows"] = follows(proposal.text, kind)
        return row

    def summarize_row(self, row: Row) -> str:
        """Whether the answer was right, and followed the rule."""
        right = "right" if is_right(row["answer"]) else "wrong"
        return right if row["part"] == "other" else f"{right}, {'follows' if row['follows'] else 'ignores'} the rule"

    def report(self, rows: list[Row]) -> list[str]:
        """Both parts, with the paired differences."""
        lines: list[str] = []
        for part, title, score in (
            ("rule", "right and as the document states", lambda row: is_right(row["answer"]) and row["follows"]),
            ("other", "right", lambda row: is_right(row["answer"])),
        ):
            some = [row for row in rows if row["part"] == part and row["reading"] != SITE_FILE and "planner" not in row]
            lines += [f"Part *{part}*:", "", *part_table(some, title, score), paired_difference(some, title, score), ""]
        rules = [row for row in rows if row["part"] == "rule"]
        passages = [row for row in rows if "planner" not in row and row["reading"] != SITE_FILE]
        kinds = kind_table([row for row in rules if "planner" not in row])
        return [*lines, *decline_table(passages), "", *kinds, "", *site_table(rules)]


Score = Callable[[Row], bool]


def paired_units(parts: Mapping[str, int]) -> list[WorkUnit]:
    """Each question of each part, of which there are so many, without and with passages, question by question."""
    asked = [(part, number) for number in range(max(parts.values())) for part in parts if number < parts[part]]
    return [
        WorkUnit(f"{part} {number}, {reading}", {"part": part, "number": number, "reading": reading})
        for part, number in asked
        for reading in ("without", "with")
    ]


def part_table(rows: Sequence[Row], title: str, score: Score) -> list[str]:
    """One line with passages and one without."""
    lines = (
        (
            reading,
            format_proportion(sum(map(score, some)), len(some)),
            format_proportion(sum(is_right(row["answer"]) for row in some), len(some)),
            format_proportion(sum(bool(row["passages"]) for row in some), len(some)),
            f"{median(row['decision_s'] for row in some):.1f}",
        )
        for reading in ("without", "with")
        if (some := [row for row in rows if row["reading"] == reading])
    )
    head = ("passages", title, "right skills and names", "with a passage in the prompt", "median decision [s]")
    return markdown_table(head, lines)


def paired_difference(rows: Sequence[Row], title: str, score: Score) -> str:
    """The difference of the shares with and without passages, on the questions that were asked both ways."""
    sides = (
        {f"{row['part']} {row['number']}": [float(score(row))] for row in rows if row["reading"] == reading}
        for reading in ("with", "without")
    )
    found = compare(*sides, difference)
    interval = f"95 % interval {found.low:+.0%} to {found.high:+.0%}"
    return f"{title.capitalize()}, with minus without: {found.effect:+.0%} ({interval})."


def kind_table(rows: Sequence[Row]) -> list[str]:
    """Rules found by search and followed, by kind."""
    lines = (
        (
            kind,
            reading,
            format_proportion(sum(row["found"] for row in some), len(some)),
            format_proportion(sum(row["follows"] for row in some), len(some)),
        )
        for kind in RULES
        for reading in ("without", "with")
        if (some := [row for row in rows if row["rule"] == kind and row["reading"] == reading])
    )
    return ["Rules by kind:", "", *markdown_table(("rule", "passages", "in the prompt", "followed"), lines)]


def decline_table(rows: Sequence[Row]) -> list[str]:
    """Declines of instructions that a contract can carry out, in both parts, with and without passages."""
    possible = [row for row in rows if not row["answer"]["declines"]]
    lines = (
        (reading, format_proportion(sum(is_declined(row["answer"]["text"]) for row in some), len(some)))
        for reading in ("without", "with")
        if (some := [row for row in possible if row["reading"] == reading])
    )
    return ["Instructions that a contract can carry out:", "", *markdown_table(("passages", "declined"), lines)]


def site_table(rows: Sequence[Row]) -> list[str]:
    """Rules kept, by planner and by the way in which it is asked."""
    asked = [(planner, reading) for planner, readings in READINGS.items() for reading in readings]
    lines = (
        (
            planner,
            reading,
            format_proportion(sum(row["follows"] for row in some), len(some)),
            format_proportion(sum(is_right(row["answer"]) for row in some), len(some)),
            format_proportion(sum(is_right(row["answer"]) and row["follows"] for row in some), len(some)),
        )
        for planner, reading in asked
        if (some := [row for row in rows if (row.get("planner", LARGE_PLANNER), row["reading"]) == (planner, reading)])
    )
    head = ("planner", "rule", "followed", "right skills and names", "right and followed")
    return ["The same rules as limits of the site file:", "", *markdown_table(head, lines)]


@cache
def rule_questions() -> tuple[Sample, ...]:
    """Held-out instructions that put one object somewhere, without exemplars."""
    drawn = generate_examples(8 * N_RULES, "test", RULE_SEED, {ROBOT: 1.0}, exemplar_share=0.0)
    placements = [one for one in drawn if [action.skill for action in reference(one)] == ["grasp", "place"]]
    chosen = [one for one in placements if len(scene_objects(one)) >= 3][:N_RULES]
    assert len(chosen) == N_RULES
    return tuple(chosen)


@cache
def other_questions() -> tuple[Sample, ...]:
    """Other held-out instructions, without exemplars."""
    return generate_examples(N_OTHERS, "test", OTHER_SEED, {ROBOT: 1.0}, exemplar_share=0.0)


def reference(question: Sample) -> tuple[Action, ...]:
    """The actions of the correct contract."""
    return msgspec.json.decode(question.contract, type=Contract).action_sequence


def scene_objects(question: Sample) -> list[str]:
    """The graspable objects of the scene, that of the instruction first."""
    asked = str(reference(question)[0].params["object"])
    return [asked, *(name for name in scene_context_by_name(question.scene).names.graspable if name != asked)]


def rule_of(number: int) -> tuple[str, RuleKind]:
    """The kind of rule of the question `number`."""
    return list(RULES.items())[number % len(RULES)]


def rule_sentence(number: int, question: Sample) -> str:
    """The rule for the object of the instruction."""
    _, kind = rule_of(number)
    return kind.sentence.format(object=words(scene_objects(question)[0]), value=kind.values[0])


def rule_document(number: int, question: Sample) -> str:
    """A site document in Markdown with the rules for three objects; that of the instruction is the second."""
    _, kind = rule_of(number)
    first, second, third = scene_objects(question)[:3]
    sections = (
        f"## Handling of the {words(name)}\n\n{kind.sentence.format(object=words(name), value=value)}\n"
        for name, value in ((second, kind.values[1]), (first, kind.values[0]), (third, kind.values[2]))
    )
    return "\n".join(("# Handling rules of this table\n", *sections))


def limited_schema(number: int, question: Sample) -> dict[str, Any]:
    """The decoding schema of a question at a site whose file limits the three objects as the document does."""
    name, kind = rule_of(number)
    limits = {
        obj: ObjectLimits(**{name: value}) for obj, value in zip(scene_objects(question)[:3], kind.values, strict=True)
    }
    context = scene_context_by_name(question.scene)
    limited = with_object_limits(context.perceived, limits)
    return answer_schema(instruction_of(question), limited, context.registry, None)


def words(name: str) -> str:
    """A name as people write it."""
    return name.replace("_", " ")


def is_declined(text: str) -> bool:
    """Whether the contract in `text` declines; False without a contract."""
    try:
        actions = msgspec.json.decode(text, type=Contract).action_sequence
    except DECODE_ERRORS:
        return False
    return [action.skill for action in actions] == [DECLINE]


def follows(text: str, kind: RuleKind) -> bool:
    """Whether every grasp and place of the contract keeps the rule; False without one."""
    try:
        actions = msgspec.json.decode(text, type=Contract).action_sequence
    except DECODE_ERRORS:
        return False
    moving = [action for action in actions if action.skill in ("grasp", "place")]
    return bool(moving) and all(kind.holds(action, kind.values[0]) for action in moving)


def find_passages(question: Sample, document: str, min_trust: TrustLevel = "vendor") -> tuple[Passage, ...]:
    """The passages for a question, from the packaged documents and a site document, of at least this trust."""
    context = scene_context_by_name(question.scene)
    with tempfile.TemporaryDirectory() as folder:
        library = Library(Path(folder) / "knowledge.sqlite", encoder(), write=True)
        try:
            add_builtin_documents(library, now=0.0)
            if document:
                library.add(Submission(file="handling.md", data=document.encode(), trust="site", kind="rule"), now=0.0)
            budget = Budget(min_trust=min_trust)
            return retrieve_passages(library, instruction_of(question), context.summary, context.registry, budget)
        finally:
            library.close()


@cache
def encoder() -> MiniLmEncoder:
    """The sentence encoder of memory and documents."""
    return MiniLmEncoder.from_cache(paths.cache_folder())
