"""The memories of a ledger with their weights, and which memories the prompt of each episode cited."""

from __future__ import annotations

from collections import Counter
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.core.text import storable_text
from dualbrain.errors import DECODE_ERRORS, DualbrainError
from dualbrain.memory.ledger.events import EPISODE
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.state.derivation import derive_state
from dualbrain.memory.state.state import MemoryState

MAX_MEMORIES = 500
"""Number of memories that are listed, the newest."""
MAX_TEXT = 400
"""Longest text of a memory [characters]."""


class _Cited(msgspec.Struct, frozen=True):
    memory: str


class _Texts(msgspec.Struct, frozen=True):
    instruction: str = ""


class _Event(msgspec.Struct, frozen=True):
    episode: _Texts = _Texts()
    retrieved: tuple[_Cited, ...] = ()


def list_memories(path: Path | None) -> dict[str, Any]:
    """The memories of the ledger at `path`, the newest first; without a readable ledger none, and the reason.

    `cites` are the memories in the prompt of the episode, `cited` is the number of prompts in which the memory was.
    """
    if path is None or not path.exists():
        return {"memories": [], "total": 0, "reason": "There is no memory ledger yet: the first run creates it."}
    try:
        with LedgerReader(path) as ledger:
            state = derive_state(ledger)
            events = {one.seq: _decode(one.payload) for one in ledger.events(EPISODE)}
    except DualbrainError as error:
        return {"memories": [], "total": 0, "reason": str(error)}
    cited = Counter(hit.memory for one in events.values() for hit in one.retrieved)
    newest = state.memories[: -MAX_MEMORIES - 1 : -1]
    rows = [_row(memory, events.get(memory.seq, _Event()), cited[memory.id]) for memory in newest]
    return {"memories": rows, "total": len(state), "event": state.seq, "reason": ""}


def _decode(payload: bytes) -> _Event:
    try:
        return msgspec.json.decode(payload, type=_Event)
    except DECODE_ERRORS:
        return _Event()


def _row(memory: MemoryState, event: _Event, cited: int) -> dict[str, Any]:
    return {
        "id": memory.id,
        "time": memory.time,
        "instruction": storable_text(event.episode.instruction, MAX_TEXT),
        "outcome": memory.kind,
        "delta": memory.Delta,
        "weight": memory.weight,
        "reinforced": memory.reinforced,
        "suppressed": memory.suppressed,
        "status": memory.status,
        "source": storable_text(memory.provenance.source, MAX_TEXT),
        "cites": [storable_text(one.memory, MAX_TEXT) for one in event.retrieved],
        "cited": cited,
    }
