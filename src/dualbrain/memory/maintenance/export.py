"""Export of memories as JSON objects for other programs, one object per memory."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec

from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.state.state import LedgerState


def export_rows(ledger: LedgerReader, state: LedgerState) -> Iterator[dict[str, Any]]:
    """Each memory, oldest first: status, weight, provenance, the stored episode and the memories that it retrieved."""
    for memo in state.memories:
        stored = msgspec.json.decode(ledger.event(memo.seq).payload)
        yield {**msgspec.to_builtins(memo), "r": memo.r, "episode": stored["episode"], "retrieved": stored["retrieved"]}
