"""Memory as lines of JSON, for other programs: one memory a line, everything that the ledger says of it."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec

from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.state.state import LedgerState


def export_rows(ledger: LedgerReader, state: LedgerState) -> Iterator[dict[str, Any]]:
    """Each memory, oldest first: status, weight and provenance beside the episode as it was stored."""
    for memo in state.memories:
        stored = msgspec.json.decode(ledger.event(memo.seq).payload)
        yield {**msgspec.to_builtins(memo), "r": memo.r, "episode": stored["episode"], "retrieved": stored["retrieved"]}
