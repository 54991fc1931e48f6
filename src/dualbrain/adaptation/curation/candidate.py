"""What curation reads of one remembered episode: words, scene, contract, the robot's verdict, the weight."""

from __future__ import annotations

from collections.abc import Iterator

import msgspec

from dualbrain.contracts.contract import Contract
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.errors import UNREADABLE
from dualbrain.memory.ledger.hash_chain import DamagedLedger
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.state.derivation import derive
from dualbrain.memory.state.state import Memo
from dualbrain.records import Scene


class _Ended(msgspec.Struct, frozen=True):
    duration: float


class _Told(msgspec.Struct, frozen=True):
    instruction: str
    summary: str
    scene: Scene
    contract: Contract | None
    outcome: _Ended
    versions: dict[str, str]


class _Stored(msgspec.Struct, frozen=True):
    episode: _Told


class Candidate(msgspec.Struct, frozen=True):
    """One episode as the ledger has it; `memo` holds its outcome, Δ, status, weight and event number."""

    memo: Memo
    instruction: str
    summary: str
    scene: Scene
    contract: Contract | None
    duration: float
    filtered: bool

    @property
    def family(self) -> tuple[str, ...]:
        """Its skills in order: what a robot knows of the kind of an errand."""
        return tuple(action.skill for action in self.contract.action_sequence) if self.contract else ()

    @property
    def names(self) -> SceneNames:
        """The names that a contract could use."""
        return SceneNames(self.scene.graspable, self.scene.receptive)


def candidates(ledger: LedgerReader) -> Iterator[Candidate]:
    """Every memory that is in effect, oldest first; raises `DamagedLedger` at one that cannot be read."""
    for memo in derive(ledger).memos:
        try:
            told = msgspec.json.decode(ledger.event(memo.seq).payload, type=_Stored).episode
        except UNREADABLE as error:
            raise DamagedLedger(f"unreadable: {error}", seq=memo.seq, path=str(ledger.path)) from error
        filtered = told.versions.get("filter") == "on"
        yield Candidate(
            memo, told.instruction, told.summary, told.scene, told.contract, told.outcome.duration, filtered
        )  # fmt: skip
