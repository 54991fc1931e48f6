"""The fields of one stored episode that curation reads: instruction, scene, contract, outcome and memory weight."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from dualbrain.contracts.contract import Contract
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.errors import DECODE_ERRORS
from dualbrain.memory.ledger.hash_chain import CorruptLedgerError
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.state.derivation import derive_state
from dualbrain.memory.state.state import MemoryState
from dualbrain.records import Scene


class _OutcomeFields(msgspec.Struct, frozen=True):
    duration: float


class _EpisodeFields(msgspec.Struct, frozen=True, kw_only=True):
    instruction: str
    summary: str
    scene: Scene
    contract: Contract | None
    outcome: _OutcomeFields
    versions: dict[str, str]


class _StoredPayload(msgspec.Struct, frozen=True):
    episode: _EpisodeFields


class Candidate(msgspec.Struct, frozen=True, kw_only=True):
    """One episode as stored in the ledger; `memory` has its outcome, Δ, status, weight and event number.

    `duration` [s] is that of the episode; `was_filtered` states that the safety filter was on.
    """

    memory: MemoryState
    instruction: str
    summary: str
    scene: Scene
    contract: Contract | None
    duration: float
    was_filtered: bool

    @property
    def skill_sequence(self) -> tuple[str, ...]:
        """Its skills in order; episodes with the same sequence count as the same kind of task."""
        return tuple(action.skill for action in self.contract.action_sequence) if self.contract else ()

    @property
    def scene_names(self) -> SceneNames:
        """The names that a contract could use."""
        return SceneNames(self.scene.graspable, self.scene.receptive)


def read_candidates(ledger: LedgerReader) -> Iterator[Candidate]:
    """Every memory that is in effect, oldest first; raises `CorruptLedgerError` for an unreadable one."""
    for memory in derive_state(ledger).memories:
        try:
            stored = msgspec.json.decode(ledger.event(memory.seq).payload, type=_StoredPayload).episode
        except DECODE_ERRORS as error:
            raise CorruptLedgerError(f"unreadable: {error}", seq=memory.seq, path=str(ledger.path)) from error
        filtered = stored.versions.get("filter") == "on"
        yield Candidate(
            memory=memory,
            instruction=stored.instruction,
            summary=stored.summary,
            scene=stored.scene,
            contract=stored.contract,
            duration=stored.outcome.duration,
            was_filtered=filtered,
        )
