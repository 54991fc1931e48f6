"""Unconstrained answers of an adapter trained on contracts, in scenes and wordings that the training data lacks.

Decoding is greedy, without grammar or schema, and the prompt contains no rules. The answers are judged by the robot's
gate for that scene, with its rules on reach, opening and held object.
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
from dualbrain.contracts.contract import Action, Contract
from dualbrain.core import paths
from dualbrain.core.weights import find_weight_file, locate_weights
from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples, scene_context_by_name
from experiments.adaptation.free_answers import FreeAnswerModel
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_proportion, markdown_table

N_QUESTIONS, QUESTIONS_PER_UNIT = 120, 10
ADAPTER, BARE_MODEL = "base-135m", "smollm2-135m-instruct"


class Language:
    """The base adapter of the main table writes contracts without constraints."""

    name = "language"
    claim = (
        f"base-135m answers {N_QUESTIONS} requests without constraints, in scenes, sentences, a task family and kinds "
        "of objects outside its training data: its contracts are compliant, with the right objects in the right order, "
        "and it follows the first exemplar that it is shown."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Ten requests per unit; a few of them also for the model without its adapter."""
        del options
        batches = [(ADAPTER, first) for first in range(0, N_QUESTIONS, QUESTIONS_PER_UNIT)] + [
            (BARE_MODEL, 0),
            (BARE_MODEL, QUESTIONS_PER_UNIT),
        ]
        return [
            WorkUnit(f"{model} questions {first}-{first + QUESTIONS_PER_UNIT - 1}", {"who": model, "first": first})
            for model, first in batches
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Generate the answers, and judge each by the gate of its scene."""
        batch = questions()[parameters["first"] : parameters["first"] + QUESTIONS_PER_UNIT]
        return {
            **parameters,
            "answers": list(map(score_question, batch, cached_model(parameters["who"]).generate(batch))),
        }

    def summarize_row(self, row: Row) -> str:
        """The number of correct answers."""
        return f"{sum(map(is_right, row['answers']))} of {len(row['answers'])} correct"

    def report(self, rows: list[Row]) -> list[str]:
        """Shares with their intervals, by what the training data lacks."""
        lines: list[str] = []
        for model in (ADAPTER, BARE_MODEL):
            answers = [one for row in rows if row["who"] == model for one in row["answers"]]
            if answers:
                lines += [f"{model}:", "", *slice_table(answers)]
        return lines


SLICES: dict[str, Callable[[dict[str, Any]], bool]] = {
    "all": lambda one: True,
    "panda": lambda one: one["scene"].startswith("panda"),
    "ur5e": lambda one: one["scene"].startswith("ur5e"),
    "base": lambda one: one["scene"].startswith("base"),
    f"family {HELD_OUT_FAMILY}": lambda one: f" {HELD_OUT_FAMILY}:" in one["scene"],
    "with a held-out kind of object": lambda one: bool(one["unknown"]),
    "two goals or more": lambda one: one["goals"] > 1,
    "to be declined": lambda one: one["declines"],
    "with exemplars": lambda one: one["shown"] > 0,
}


def slice_table(answers: list[dict[str, Any]]) -> list[str]:
    """One line per slice."""
    parts = {name: [one for one in answers if belongs(one)] for name, belongs in SLICES.items()}
    scores = ("json", "compliant", "skills")
    cells = (
        (
            name,
            *(format_proportion(sum(one[score] for one in some), len(some)) for score in scores),
            format_proportion(sum(map(is_right, some)), len(some)),
            exemplar_agreement(some),
        )
        for name, some in parts.items()
        if some
    )
    return markdown_table(
        (
            "requests",
            "JSON",
            "compliant",
            "correct skills in order",
            "correct",
            "free parameters as in the first exemplar",
        ),
        cells,
    )


def is_right(one: dict[str, Any]) -> bool:
    """Whether an answer is compliant and has the correct skills in order, on the correct objects."""
    return bool(one["compliant"] and one["skills"] and one["named"])


def exemplar_agreement(answers: list[dict[str, Any]]) -> str:
    """How many free parameters equal those of the first exemplar, if one with the same steps is shown."""
    same, every = (sum(one["taken"][i] for one in answers) for i in (0, 1))
    return f"{same} of {every}" if every else "-"


@cache
def questions() -> tuple[Sample, ...]:
    """The requests, always the same."""
    return generate_examples(N_QUESTIONS, "test")


@cache
def cached_model(name: str) -> FreeAnswerModel:
    """The model called `name` with its adapters, opened once per process."""
    if name in packaged_names():
        return FreeAnswerModel(load_stack(packaged_folder(name), paths.cache_folder()))
    return FreeAnswerModel(AdapterStack(find_weight_file(name).name, locate_weights(name, paths.cache_folder()), ()))


def score_question(question: Sample, text: str) -> dict[str, Any]:
    """The score of an answer, with the properties of its request."""
    context = scene_context_by_name(question.scene)
    score: AnswerScore = score_answer(text, question.contract, context.registry, context.accepts)
    reference = msgspec.json.decode(question.contract, type=Contract).action_sequence
    named = {str(value) for action in reference for value in action.params.values()}
    unknown = sorted(name for name in named if name.rpartition("_")[2] in HELD_OUT_CATEGORIES)
    return {
        "id": question.id,
        "scene": question.scene,
        "text": text,
        "wanted": question.contract,
        **msgspec.to_builtins(score),
        "unknown": unknown,
        "goals": len(reference) // 2 + len(reference) % 2,
        "declines": reference[0].skill == "decline",
        "shown": len(exemplar_actions(question)),
        "taken": copied_parameters(question, text) if score.skills else (0, 0),
    }


def exemplar_actions(question: Sample) -> list[list[Action]]:
    """The actions of the exemplars in the prompt."""
    lines = re.findall("<example>\n(.*)\n</example>", question.prompt[-1]["content"])
    return [msgspec.convert(json.loads(line), list[Action]) for line in lines]


def copied_parameters(question: Sample, text: str) -> tuple[int, int]:
    """(copied, all): free parameters of steps that the first exemplar has, too, and how many of them the answer copies.

    The n-th action with a skill is compared with the exemplar's n-th action with that skill, or its last.
    """
    registry = scene_context_by_name(question.scene).registry
    first = next(iter(exemplar_actions(question)), [])
    same = every = 0
    occurrences: Counter[str] = Counter()
    for action in msgspec.json.decode(text, type=Contract).action_sequence:
        instructed = [name for skill, name in INSTRUCTED_NUMBERS if skill == action.skill]
        shown = [free_parameters(registry, one, instructed) for one in first if one.skill == action.skill]
        if shown:
            exemplar = shown[min(occurrences[action.skill], len(shown) - 1)]
            own = free_parameters(registry, action, instructed)
            same += sum(own.get(name) == value for name, value in exemplar.items())
            every += len(exemplar)
        occurrences[action.skill] += 1
    return same, every
