"""Overlap of held-out questions with the training data of adapters, as far as it is recorded."""

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
    questions: Sequence[Sample], cards: Sequence[AdapterCard], dataset: Dataset, ledger: LedgerReader | None = None
) -> tuple[Sample, ...]:
    """The samples of `questions` that are not known to be training data of any adapter of `cards`.

    The training part of `dataset` is known for adapters trained on it. `ledger` records the memories that an adapter,
    or another adapter of the same data set, was trained on. Training data from elsewhere is unknown.
    """
    ids, sets = {card.id for card in cards}, {card.dataset for card in cards}
    rows = dataset.train if dataset.card.hash in sets else ()
    uses = [use for use in _adapter_uses(ledger) if use.adapter in ids or use.dataset in sets] if ledger else []
    trained = frozenset[str]().union(*(row.memories for row in rows), *(use.memories for use in uses))
    samples = {row.id for row in rows}
    return tuple(one for one in questions if not one.memories & trained and one.id not in samples)


def _adapter_uses(ledger: LedgerReader) -> list[AdapterUse]:
    return [msgspec.json.decode(event.payload, type=AdapterUse) for event in effective_events(ledger, (ADAPTER,))]
