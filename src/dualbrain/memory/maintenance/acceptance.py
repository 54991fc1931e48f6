"""Acceptance of a ledger that lacks events of its anchors, so that it can be written again."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from dualbrain.errors import ConfigurationError
from dualbrain.memory.learning.consolidation import PERSON_ACTOR
from dualbrain.memory.ledger.anchors import AnchorReport, accepted_loss
from dualbrain.memory.ledger.events import ACCEPTED
from dualbrain.memory.ledger.hash_chain import verified_events
from dualbrain.memory.ledger.ledger import Ledger, PendingEvent


def accept_ledger(
    path: Path,
    reason: str,
    *,
    holder: str,
    now: float,
    timeout_s: float = 0.0,
    run_folders: Sequence[Path] = (),
    actor: str = PERSON_ACTOR,
) -> AnchorReport:
    """Accept the ledger at `path` as it is, and return the comparison with its anchors before that.

    An event records the anchors whose events are missing, with `reason` and `actor`; they are not reported again.
    Missing indices and triggers are created again, and a missing ledger is created empty. A broken chain cannot be
    accepted.

    Raises `ConfigurationError` without a reason, `CorruptLedgerError` if the chain is broken, and what `Ledger` raises.
    """
    if not reason.strip():
        raise ConfigurationError.stating("The reason is empty.", fix="State why the loss is intended: --accept REASON.")
    with Ledger(
        path, holder=holder, now=now, timeout_s=timeout_s, run_folders=run_folders, accept_faults=True
    ) as ledger:
        for _ in verified_events(ledger.events(), str(path)):
            pass
        if ledger.anchor_report.faults:
            payload = accepted_loss(ledger.anchor_report, reason, actor)
            ledger.append([PendingEvent(kind=ACCEPTED, subject="", payload=payload)], now=now)
        ledger.anchor()
        return ledger.anchor_report
