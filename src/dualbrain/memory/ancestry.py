"""Whether a ledger is the one that something was read from, also after it has grown or was compacted."""

from __future__ import annotations

from dualbrain.memory.chain import Head
from dualbrain.memory.ledger import LedgerReader
from dualbrain.memory.state import origin


def goes_on_from(ledger: LedgerReader, head: Head) -> bool:
    """Whether the event `head` stands in `ledger`, or in a ledger that it was compacted from and that lies beside it.

    Events are chained: who holds this one holds all before it.
    """
    if any(event.hash == head.hash for event in ledger.events("seq = ?", (head.seq,))):
        return True
    first = next(ledger.events("seq = 1"), None)
    if first is None or (longer := origin(first)) is None:
        return False
    archive = ledger.path.with_name(f"{longer.archive}.archive-{longer.seq}")
    if not archive.is_file():
        return False
    with LedgerReader(archive) as opened:
        return goes_on_from(opened, head)
