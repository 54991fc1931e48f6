"""language: an adapter that was taught the language of contracts, asked freely in scenes and words it has never seen.

Greedy, with no grammar, no schema and no rules in the prompt. The gate that judges is the one before the robot in that
scene, with its rules of reach, opening and hand.
"""

from __future__ import annotations

import json
import re
from collections import Counter
from collections.abc import Callable
from functools import cache
from typing import Any

import msgspec

from dualbrain.adaptation.adapters.packaged import packaged_folder, packaged_names
from dualbrain.adaptation.adapters.stacking import AdapterStack, load_stack
from dualbrain.adaptation.curation.sample import Sample
from dualbrain.adaptation.synthetic.example import free_parameters
from dualbrain.adaptation.synthetic.scoring import INSTRUCTED_NUMBERS, AnswerScore, score_answer
from dualbrain.adaptation.synthetic.split import HELD_OUT_CATEGORIES, HELD_OUT_FAMILY
from dualbrain.cli.common import paths
from dualbrain.contracts.contract import Action, Contract
from dualbrain.core.weights import find_weight_file, locate_weights
from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples, scene_context_by_name
from experiments.adaptation.free_answers import FreeAnswerModel
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_proportion, markdown_table

N_QUESTIONS, QUESTIONS_PER_UNIT = 120, 10
ADAPTER, BARE_MODEL = "base-135m", "smollm2-135m-instruct"


class Language:
    """The base of the main table speaks."""

    name = "language"
    claim = (
        f"base-135m answers {N_QUESTIONS} questions freely, in scenes, sentences, a task family and things that it was "
        "not taught: compliant, the right things, in the right order; and it follows the first exemplar it is shown."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Ten questions a unit; a few of them also to the model without its adapter."""
        del options
        asked = [(ADAPTER, first) for first in range(0, N_QUESTIONS, QUESTIONS_PER_UNIT)] + [
            (BARE_MODEL, 0),
            (BARE_MODEL, QUESTIONS_PER_UNIT),
        ]
        return [
            WorkUnit(f"{who} questions {first}-{first + QUESTIONS_PER_UNIT - 1}", {"who": who, "first": first})
            for who, first in asked
        ]

    def run(self, about: dict[str, Any]) -> Row:
        """Ask, and judge each answer by the gate of its scene."""
        asked = questions()[about["first"] : about["first"] + QUESTIONS_PER_UNIT]
        return {**about, "answers": list(map(score_question, asked, cached_model(about["who"]).generate(asked)))}

    def summarize_row(self, row: Row) -> str:
        """How many were right."""
        return f"{sum(map(is_right, row['answers']))} of {len(row['answers'])} right"

    def report(self, rows: list[Row]) -> list[str]:
        """Shares with their intervals, by what had not been taught."""
        lines: list[str] = []
        for who in (ADAPTER, BARE_MODEL):
            answers = [one for row in rows if row["who"] == who for one in row["answers"]]
            if answers:
                lines += [f"{who}:", "", *slice_table(answers)]
        return lines


SLICES: dict[str, Callable[[dict[str, Any]], bool]] = {
    "all": lambda one: True,
    "panda": lambda one: one["scene"].startswith("panda"),
    "ur5e": lambda one: one["scene"].startswith("ur5e"),
    "base": lambda one: one["scene"].startswith("base"),
    f"family {HELD_OUT_FAMILY}": lambda one: f" {HELD_OUT_FAMILY}:" in one["scene"],
    "asked for a held-out kind of thing": lambda one: bool(one["unknown"]),
    "two goals or more": lambda one: one["goals"] > 1,
    "to be declined": lambda one: one["declines"],
    "with exemplars": lambda one: one["shown"] > 0,
}


def slice_table(answers: list[dict[str, Any]]) -> list[str]:
    """One line a slice."""
    parts = {name: [one for one in answers if belongs(one)] for name, belongs in SLICES.items()}
    cells = (
        (
            name,
            *(format_proportion(sum(one[what] for one in some), len(some)) for what in ("json", "compliant", "skills")),
            format_proportion(sum(map(is_right, some)), len(some)),
            exemplar_agreement(some),
        )
        for name, some in parts.items()
        if some
    )
    return markdown_table(
        (
            "questions",
            "JSON",
            "compliant",
            "right skills in order",
            "right",
            "open parameters as in the first exemplar",
        ),
        cells,
    )


def is_right(one: dict[str, Any]) -> bool:
    """Compliant, the right skills in the right order, on the right things."""
    return bool(one["compliant"] and one["skills"] and one["named"])


def exemplar_agreement(answers: list[dict[str, Any]]) -> str:
    """How many open parameters are those of the first exemplar, where one with like steps is shown."""
    same, every = (sum(one["taken"][i] for one in answers) for i in (0, 1))
    return f"{same} of {every}" if every else "-"


@cache
def questions() -> tuple[Sample, ...]:
    """The questions, always the same."""
    return generate_examples(N_QUESTIONS, "test")


@cache
def cached_model(name: str) -> FreeAnswerModel:
    """The model called `name` with what it wears, opened once a process."""
    if name in packaged_names():
        return FreeAnswerModel(load_stack(packaged_folder(name), paths.cache_folder()))
    return FreeAnswerModel(AdapterStack(find_weight_file(name).name, locate_weights(name, paths.cache_folder()), ()))


def score_question(question: Sample, text: str) -> dict[str, Any]:
    """The score of an answer, with what its question is an instance of."""
    setting = scene_context_by_name(question.scene)
    found: AnswerScore = score_answer(text, question.contract, setting.registry, setting.accepts)
    wanted = msgspec.json.decode(question.contract, type=Contract).action_sequence
    named = {str(value) for action in wanted for value in action.params.values()}
    unknown = sorted(name for name in named if name.rpartition("_")[2] in HELD_OUT_CATEGORIES)
    return {
        "id": question.id,
        "scene": question.scene,
        "text": text,
        "wanted": question.contract,
        **msgspec.to_builtins(found),
        "unknown": unknown,
        "goals": len(wanted) // 2 + len(wanted) % 2,
        "declines": wanted[0].skill == "decline",
        "shown": len(exemplar_actions(question)),
        "taken": copied_parameters(question, text) if found.skills else (0, 0),
    }


def exemplar_actions(question: Sample) -> list[list[Action]]:
    """The steps of the exemplars in the prompt."""
    lines = re.findall("<example>\n(.*)\n</example>", question.prompt[-1]["content"])
    return [msgspec.convert(json.loads(line), list[Action]) for line in lines]


def copied_parameters(question: Sample, text: str) -> tuple[int, int]:
    """Of the open parameters for which the first exemplar has a like step, how many the answer takes, and how many.

    Its n-th step of a kind is compared with the exemplar's n-th of that kind, or its last.
    """
    registry = scene_context_by_name(question.scene).registry
    first = next(iter(exemplar_actions(question)), [])
    same = every = 0
    turns: Counter[str] = Counter()
    for action in msgspec.json.decode(text, type=Contract).action_sequence:
        said = [name for skill, name in INSTRUCTED_NUMBERS if skill == action.skill]
        models = [free_parameters(registry, one, said) for one in first if one.skill == action.skill]
        if models:
            model = models[min(turns[action.skill], len(models) - 1)]
            own = free_parameters(registry, action, said)
            same, every = same + sum(own.get(name) == value for name, value in model.items()), every + len(model)
        turns[action.skill] += 1
    return same, every
