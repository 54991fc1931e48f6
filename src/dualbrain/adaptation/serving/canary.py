"""Canaries: questions whose answers by an adapter were recorded, asked again of every process that should wear it.

Serving engines are known to answer from the wrong adapter, or from none, without a word. Recorded and compared in the
same runtime; the tokens must be the same, and so must be how sure each was: two adapters may say the same words, but
hardly with the same probabilities. What follows a near-tie is not compared.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable
from pathlib import Path

import msgspec

from dualbrain.adaptation.adapters.card import AdapterCard
from dualbrain.adaptation.serving.raw_completion import RawCompletion, complete
from dualbrain.core.storage.atomic_files import write_atomically
from dualbrain.errors import ConfigurationError
from dualbrain.planner.backends.http_chat import ChatResponse
from dualbrain.planner.backends.llama_cpp import LlamaPlanner
from dualbrain.planner.prompt.short_prompt import render_short

MAX_ANSWER_TOKENS = 32
"""Tokens of an answer."""
MIN_MARGIN = 0.05
"""The least margin [nats] of what is compared: below, rounding may turn a token."""
MAX_MARGIN_DIFFERENCE = 0.1
"""Mean difference of margins [nats] that is still the same adapter; the same process and file give 0."""
N_AT_START = 1
"""How many are asked when a process starts; all of them by `dualbrain adapters verify`."""
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
    """One question of `SCENES` by number, and the answer up to its first near-tie: tokens and their margins [nats]."""

    question: int
    tokens: tuple[int, ...]
    margins: tuple[float, ...]


class CanaryRecord(msgspec.Struct, frozen=True):
    """What `adapter` answered in `runtime`."""

    adapter: str
    runtime: str
    canaries: tuple[Canary, ...]


class CanaryCheck:
    """The canaries of one adapter in one runtime, kept in `folder`; recorded by the first process that is asked.

    `below` makes a planner without the adapter: one that answers the same with and without has no effect, and is
    refused when it is recorded.
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
        """Watch the adapter of `card`; `worn` is the hash of what says how it is worn."""
        name = hashlib.sha256(f"{card.id} {config_hash} {runtime}".encode()).hexdigest()[:32]
        self.path = folder / f"{name}.json"
        self._card, self._runtime, self._open_without_adapter = card, runtime, open_without_adapter

    def __call__(self, planner: LlamaPlanner, max_canaries: int = N_AT_START) -> str:
        """What is wrong with the answers of `planner`, "" if nothing is; at most `most` canaries are asked.

        Raises `InvalidSetup` for a damaged record, `DiskFull` for one that cannot be written.
        """
        known = self.read_record()
        if known is None:
            return self._record_answers(planner)
        for canary in known.canaries[:max_canaries]:
            if fault := _describe_difference(canary, ask_canary(planner, self._card, canary.question)):
                return fault
        return ""

    def read_record(self) -> CanaryRecord | None:
        """What is recorded of this adapter in this runtime, None before its first start; raises `InvalidSetup`.

        A record that is damaged, or of somebody else, is never replaced by whatever answers now.
        """
        try:
            found = msgspec.json.decode(self.path.read_bytes(), type=CanaryRecord)
        except FileNotFoundError:
            return None
        except (OSError, ValueError, RecursionError) as error:
            raise self._corrupt_record_error(str(error)) from error
        if (found.adapter, found.runtime) != (self._card.id, self._runtime):
            raise self._corrupt_record_error(f"the record of {found.adapter[:16]} in {found.runtime}")
        if not found.canaries or not all(map(_is_valid, found.canaries)):
            raise self._corrupt_record_error("canaries that cannot be asked")
        return found

    def _corrupt_record_error(self, got: str) -> ConfigurationError:
        fix = (
            f"Fetch it from a backup, or, if you trust what serves now, delete it: the next start records anew. "
            f"{self.path}"
        )
        return ConfigurationError(
            f"canaries of adapter {self._card.id[:16]}", got=got, allowed="as first recorded", fix=fix
        )

    def _record_answers(self, planner: LlamaPlanner) -> str:
        """Record the canaries, the longest clear answer first."""
        answers = [(number, ask_canary(planner, self._card, number)) for number in range(len(CANARY_QUESTIONS))]
        said = [(number, one) for number, one in answers if isinstance(one, RawCompletion)]
        if not said:
            return "no answer to any canary"
        canaries = sorted((_cut_at_near_tie(number, one) for number, one in said), key=lambda one: -len(one.tokens))
        if not canaries[0].tokens:
            return "no answer is clear enough to know it by"
        if self._has_no_effect(canaries[0]):
            return "it answers as if no adapter were worn"
        self.path.parent.mkdir(parents=True, exist_ok=True)
        record = CanaryRecord(self._card.id, self._runtime, tuple(one for one in canaries if one.tokens))
        write_atomically(self.path, msgspec.json.format(msgspec.json.encode(record), indent=2))
        return ""

    def _has_no_effect(self, canary: Canary) -> bool:
        below = self._open_without_adapter()
        try:
            return not _describe_difference(canary, ask_canary(below, self._card, canary.question))
        finally:
            below.close()


def ask_canary(planner: LlamaPlanner, card: AdapterCard, number: int) -> RawCompletion | ChatResponse:
    """The answer to one canary question, after the beginning that every answer has."""
    scene, words = CANARY_QUESTIONS[number]
    turns = [
        {"role": turn["role"], "content": turn["content"]}
        for turn in render_short(
            scene.format(robot=card.robot), words, robot=card.robot, registry=card.registry, contract_id="c-0001"
        )
    ]
    context = f'{{"id":"c-0001","context":{{"robot":"{card.robot}","registry":"{card.registry}"}},"action_sequence'
    return complete(planner, [*turns, {"role": "assistant", "content": context}], max_tokens=MAX_ANSWER_TOKENS)


def _is_valid(canary: Canary) -> bool:
    """Whether it is one that this program records."""
    return canary.question in range(len(CANARY_QUESTIONS)) and 0 < len(canary.tokens) == len(canary.margins)


def _cut_at_near_tie(number: int, said: RawCompletion) -> Canary:
    """`said` up to its first token that is not clearly the best."""
    count = next((place for place, margin in enumerate(said.margins) if margin < MIN_MARGIN), len(said.margins))
    return Canary(number, said.tokens[:count], said.margins[:count])


def _describe_difference(canary: Canary, said: RawCompletion | ChatResponse) -> str:
    """How `said` differs from what was recorded, "" if it does not."""
    if isinstance(said, ChatResponse):
        return f"canary {canary.question} was not answered ({said.finish_reason} {said.detail})".strip()
    count = len(canary.tokens)
    if said.tokens[:count] != canary.tokens:
        return f"canary {canary.question} was answered otherwise: {said.text[-60:]!r}"
    gaps = [abs(now - then) for now, then in zip(said.margins[:count], canary.margins, strict=True)]
    if (gap := sum(gaps) / max(1, count)) > MAX_MARGIN_DIFFERENCE:
        return f"canary {canary.question} was answered alike, but its tokens are {gap:.2g} nats from what is recorded"
    return ""
