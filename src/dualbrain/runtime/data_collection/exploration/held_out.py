"""Held-out questions of an exploration: they name generated scenes, in which the answers of a planner are executed."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from pathlib import Path

import msgspec

from dualbrain.adaptation.curation.curate import CONTRACT_ID
from dualbrain.adaptation.curation.dataset import DatasetCard
from dualbrain.adaptation.curation.sample import Sample, assistant_turn
from dualbrain.planner.prompt.short_prompt import render_short
from dualbrain.runtime.data_collection.rollouts import LEDGER_FILE, instruction_of, run_proposal
from dualbrain.runtime.data_collection.synthetic_scenes import scene_context_by_name


def has_generated_scenes(card: DatasetCard) -> bool:
    """Whether the samples of the data set name generated scenes: a data set of one ledger names groups of scenes."""
    return card.scene_values and not card.ledger


def without_values(question: Sample) -> Sample:
    """`question` as a planner reads it that was trained on scenes without fitting values; its id stays."""
    context = scene_context_by_name(question.scene)
    registry = context.registry
    prompt = render_short(
        context.summary,
        instruction_of(question),
        robot=registry.robot,
        registry=registry.hash,
        contract_id=CONTRACT_ID,
    )
    messages = [{"role": turn["role"], "content": turn["content"]} for turn in prompt]
    return msgspec.structs.replace(question, prompt=messages)


def make_scene_evaluator(seed: int, cache: Path) -> Callable[[Sample, str], tuple[bool, float | None]]:
    """Executes an answer in the full simulation of its scene: the robot's own verdict, and Δ.

    `seed` is that of the first question, and each further question has the next number. All answers to one question are
    executed with its seed, so that equal answers of two planners have equal results.
    """
    numbers: dict[str, int] = {}

    def execute(question: Sample, answer: str) -> tuple[bool, float | None]:
        turn = numbers.setdefault(question.id, seed + len(numbers))
        answered = msgspec.structs.replace(question, completion=assistant_turn(answer))
        with tempfile.TemporaryDirectory(prefix="dualbrain-answer-") as folder:
            outcome = run_proposal(answered, Path(folder) / LEDGER_FILE, turn, cache=cache).outcome
        return outcome.kind == "succeeded", outcome.Delta

    return execute
