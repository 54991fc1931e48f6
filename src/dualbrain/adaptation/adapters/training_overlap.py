"""Which questions were not among what an adapter was taught, as far as that is written down anywhere."""

from __future__ import annotations

from collections.abc import Sequence

import msgspec

from dualbrain.adaptation.adapters.card import AdapterCard
from dualbrain.adaptation.curation.dataset import Dataset
from dualbrain.adaptation.curation.sample import Sample
from dualbrain.memory.ledger.events import ADAPTER, AdapterUse
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.state.derivation import effective_events


def unseen_samples(
    asked: Sequence[Sample], cards: Sequence[AdapterCard], dataset: Dataset, ledger: LedgerReader | None = None
) -> tuple[Sample, ...]:
    """Those of `asked` that are not known to have taught any of the adapters of `cards`.

    Known is the training part of `dataset` to whoever was taught on that, and what `ledger` says that an adapter, or
    another of the same data set, was taught. Of what was taught elsewhere nothing is known.
    """
    ids, sets = {card.id for card in cards}, {card.dataset for card in cards}
    rows = dataset.train if dataset.card.hash in sets else ()
    uses = [use for use in _adapter_uses(ledger) if use.adapter in ids or use.dataset in sets] if ledger else []
    taught = frozenset[str]().union(*(row.memories for row in rows), *(use.memories for use in uses))
    samples = {row.id for row in rows}
    return tuple(one for one in asked if not one.memories & taught and one.id not in samples)


def _adapter_uses(ledger: LedgerReader) -> list[AdapterUse]:
    return [msgspec.json.decode(event.payload, type=AdapterUse) for event in effective_events(ledger, (ADAPTER,))]
