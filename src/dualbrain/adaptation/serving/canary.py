"""Canaries: questions with recorded answers that every new process with an adapter must reproduce.

Serving engines are known to answer from a wrong adapter, or from none, without an error. Answers are recorded and
compared in the same runtime. The tokens must be equal, and so must the margins: two adapters may give the same text,
but hardly with the same probabilities. Tokens after a near-tie are not compared.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import msgspec

from dualbrain.adaptation.adapters.card import AdapterCard
from dualbrain.adaptation.serving.raw_completion import RawCompletion, complete
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.core.storage.private_files import create_private_folder
from dualbrain.errors import ConfigurationError
from dualbrain.planner.backends.http_chat import ChatResponse
from dualbrain.planner.backends.llama_cpp import LlamaPlanner
from dualbrain.planner.prompt.short_prompt import render_short

MAX_ANSWER_TOKENS = 32
"""Maximum number of tokens of an answer."""
MIN_MARGIN = 0.05
"""Minimum margin [nats] of a compared token: below it, rounding may change the token."""
MAX_MARGIN_DIFFERENCE = 0.1
"""Largest mean difference of margins [nats] that counts as the same adapter; the same process and file give 0."""
N_AT_START = 1
"""Number of canaries asked when a process starts; `dualbrain adapters verify --answers` asks all."""
CANARY_QUESTIONS = (
    (
        "robot {robot}; holding nothing\nred_cube: object, free_finger_axis along, path_max_height none\n"
        "blue_bowl: container\nperson: none\nplaces: table_left",
        "put the red cube in the blue bowl",
    ),
    (
        "robot {robot}; holding nothing\ngreen_can: object, free_finger_axis across, neighbour_along tall >6cm, "
        "path_max_height tall\nwhite_tray: container\nperson: crossing\nplaces: shelf",
        "the green can goes on the tray",
    ),
    ("robot {robot}\nplaces: kitchen, window, desk\nstanding about: crate_7\nperson: none", "please go to the window"),
    (
        "robot {robot}; holding nothing\nyellow_ball: object, near_edge, free_finger_axis along, path_max_height low\n"
        "blue_bowl: container\nperson: none\nplaces: table_left",
        "bring the purple cup",
    ),
)


class Canary(msgspec.Struct, frozen=True):
    """One question by its index in `CANARY_QUESTIONS`, with the recorded answer up to its first near-tie.

    `tokens` are token ids, `margins` [nats] their margins over the next best token.
    """

    question: int
    tokens: tuple[int, ...]
    margins: tuple[float, ...]


class CanaryRecord(msgspec.Struct, frozen=True):
    """The answers of `adapter` in `runtime`."""

    adapter: str
    runtime: str
    canaries: tuple[Canary, ...]


class CanaryCheck:
    """The canaries of one adapter in one runtime, stored in `folder` and recorded by the first process that is checked.

    `open_without_adapter` starts a planner without the adapter: if it gives the same answer, the adapter has no effect
    and is rejected at recording.
    """

    def __init__(
        self,
        folder: Path,
        card: AdapterCard,
        runtime: str,
        open_without_adapter: Callable[[], LlamaPlanner],
        *,
        config_hash: str = "",
    ) -> None:
        """Check the adapter of `card`; `config_hash` is the hash of its LoRA settings."""
        name = hashlib.sha256(f"{card.id} {config_hash} {runtime}".encode()).hexdigest()[:32]
        self.path = folder / f"{name}.json"
        self._card, self._runtime, self._open_without_adapter = card, runtime, open_without_adapter

    def __call__(self, planner: LlamaPlanner, max_canaries: int = N_AT_START) -> str:
        """The fault in the answers of `planner`, "" if there is none; at most `max_canaries` are asked.

        Raises `ConfigurationError` for a damaged record, `FileWriteError` for one that cannot be written.
        """
        known = self.read_record()
        if known is None:
            return self._record_answers(planner)
        for canary in known.canaries[:max_canaries]:
            if fault := _describe_difference(canary, ask_canary(planner, self._card, canary.question)):
                return fault
        return ""

    def read_record(self) -> CanaryRecord | None:
        """The record of this adapter in this runtime, None before the first start; raises `ConfigurationError`.

        A record that is damaged or of another adapter is never overwritten with present answers.
        """
        try:
            found = msgspec.json.decode(self.path.read_bytes(), type=CanaryRecord)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, RecursionError) as error:
            raise self._corrupt_record_error(str(error)) from error
        if (found.adapter, found.runtime) != (self._card.id, self._runtime):
            raise self._corrupt_record_error(f"it is the record of {found.adapter[:16]} in {found.runtime}")
        if not found.canaries or not all(map(_is_valid, found.canaries)):
            raise self._corrupt_record_error("its canaries are incomplete")
        return found

    def _corrupt_record_error(self, fault: str) -> ConfigurationError:
        fix = (
            f"Restore it from a backup, or, if you trust the present answers, delete it: the next start records "
            f"them. {self.path}"
        )
        problem = f"The canary record of adapter {self._card.id[:16]} is damaged: {fault}."
        return ConfigurationError.stating(problem, fix=fix)

    def _record_answers(self, planner: LlamaPlanner) -> str:
        """Record the canaries, the longest clear answer first."""
        answers = [(number, ask_canary(planner, self._card, number)) for number in range(len(CANARY_QUESTIONS))]
        complete_answers = [(number, one) for number, one in answers if isinstance(one, RawCompletion)]
        if not complete_answers:
            return "no canary was answered"
        canaries = sorted(
            (_cut_at_near_tie(number, one) for number, one in complete_answers), key=lambda one: -len(one.tokens)
        )
        if not canaries[0].tokens:
            return "no canary answer has margins large enough to identify the adapter"
        if self._has_no_effect(canaries[0]):
            return "it answers as if no adapter were loaded"
        create_private_folder(self.path.parent)
        record = CanaryRecord(self._card.id, self._runtime, tuple(one for one in canaries if one.tokens))
        write_atomically(self.path, msgspec.json.format(msgspec.json.encode(record), indent=2))
        return ""

    def _has_no_effect(self, canary: Canary) -> bool:
        without_adapter = self._open_without_adapter()
        try:
            return not _describe_difference(canary, ask_canary(without_adapter, self._card, canary.question))
        finally:
            without_adapter.close()


def ask_canary(planner: LlamaPlanner, card: AdapterCard, number: int) -> RawCompletion | ChatResponse:
    """The answer to one canary question, after the prefix that all contracts share."""
    scene, instruction = CANARY_QUESTIONS[number]
    turns = [
        {"role": turn["role"], "content": turn["content"]}
        for turn in render_short(
            scene.format(robot=card.robot), instruction, robot=card.robot, registry=card.registry, contract_id="c-0001"
        )
    ]
    context = f'{{"id":"c-0001","context":{{"robot":"{card.robot}","registry":"{card.registry}"}},"action_sequence'
    return complete(planner, [*turns, {"role": "assistant", "content": context}], max_tokens=MAX_ANSWER_TOKENS)


def _is_valid(canary: Canary) -> bool:
    """Whether the canary has the form that this version records."""
    return canary.question in range(len(CANARY_QUESTIONS)) and 0 < len(canary.tokens) == len(canary.margins)


def _cut_at_near_tie(number: int, answer: RawCompletion) -> Canary:
    """`answer` up to its first token without a sufficient margin."""
    count = next((place for place, margin in enumerate(answer.margins) if margin < MIN_MARGIN), len(answer.margins))
    return Canary(number, answer.tokens[:count], answer.margins[:count])


def _describe_difference(canary: Canary, answer: RawCompletion | ChatResponse) -> str:
    """How `answer` differs from the recorded one, "" if it does not."""
    if isinstance(answer, ChatResponse):
        return f"canary {canary.question} was not answered ({answer.finish_reason} {answer.detail})".strip()
    count = len(canary.tokens)
    if answer.tokens[:count] != canary.tokens:
        return f"canary {canary.question} was answered differently: {answer.text[-60:]!r}"
    gaps = [abs(now - then) for now, then in zip(answer.margins[:count], canary.margins, strict=True)]
    if (gap := sum(gaps) / max(1, count)) > MAX_MARGIN_DIFFERENCE:
        return f"canary {canary.question} has the recorded tokens, but its margins differ by {gap:.2g} nats on average"
    return ""
