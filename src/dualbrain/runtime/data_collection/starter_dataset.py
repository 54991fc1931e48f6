"""starter-135m: what a robot teaches its planner on the first night, after a day of contracts that chance proposed.

Lessons are drawn by seed and carried out in their scenes with the filter on. A deed is taught if the robot's own
verdict was success and Δ small, and for no other reason. That nothing moved proves nothing, so declines are let in by
another word: the lesson was drawn as one that cannot or must not be done. They are carried out, too, and stand in the
ledger.

It sits on base-135m: a night teaches a body, not a language. Fitted on the bare model by the same samples it was right
in 16 of 60 held-out questions instead of 36 (docs/results/LOG.md).
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

from dualbrain.adaptation.config import AdaptConfig, FitDials
from dualbrain.adaptation.curation.curate import Curation, curate
from dualbrain.adaptation.curation.dataset import FORM, Dataset, DatasetCard, dataset_of, made_otherwise, other_dials
from dualbrain.adaptation.curation.selection import CleanRules
from dualbrain.core.storage.resumable_steps import left_by_steps
from dualbrain.grounding.vocabulary import vocabulary
from dualbrain.memory.ledger.hash_chain import Head
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.state.history import goes_on_from
from dualbrain.records import Episode
from dualbrain.runtime.data_collection.rollouts import (
    EPSILON,
    LEDGER,
    ROBOT,
    declined,
    flown,
    memory_of,
    proposals,
    proposed,
)

BASE = "base-135m"
SEED, PROPOSALS = 900, 1400
"""Of the proposals about one in eight is to be declined; the others are flights, and about half of them teach."""
DEEDS_A_DECLINE = 5
"""At most one decline for so many deeds is taught."""
DIALS = AdaptConfig(
    curation=Curation(rules=CleanRules(epsilon=EPSILON)),
    fit=FitDials(steps=150, batch=8, at_once=4, save_every=10, ask_at_most=0, patience=15, threads=1),
)
"""The whole objective. Checked by the loss alone, for free answers take as long as twenty steps."""


def first_day(
    folder: Path, number: int, *, cache: Path, tell: Callable[[int, Episode], None]
) -> Path:  # fmt: skip
    """`number` proposals carried out, see `flown`; the same ones whenever they are drawn again."""
    wanted = proposals(SEED, number, declines=True)
    return flown(folder, number, wanted.__getitem__, cache=cache, tell=tell)


def taught(day: Path) -> Dataset:
    """What the day in the folder `day` teaches; raises `InvalidSetup` if no deed in it went well."""
    registry, dials = vocabulary(ROBOT), DIALS.curation
    with LedgerReader(day / LEDGER) as ledger:
        deeds = curate(ledger, registry, dials)
        most = (len(deeds.train) + len(deeds.held_out)) // DEEDS_A_DECLINE
        declines = [memory_of(turn) for turn, one in enumerate(proposed(day)) if declined(one)][:most]
        return dataset_of(curate(ledger, registry, dials, declines=declines), registry, dials)


def not_taught(card: DatasetCard, folder: Path, number: int) -> str:
    """In what the data set of `card` is another than that of a day of `number` proposals in `folder`; "" if in none.

    The vocabulary, the prompt and the dials are those of today, the ledger is the day's, and what teaches there and on
    which side of the split is chosen as it would be today.
    """
    registry = vocabulary(ROBOT)
    made: dict[str, object] = {
        "form": FORM, "robot": ROBOT, "registry": registry.hash, "also": {}, "site": "", "memories": number,
    }  # fmt: skip
    others = [made_otherwise(card, made), other_dials(card, DIALS.curation)]
    lived = left_by_steps(folder)
    if lived is None or not _of_day(card, lived):
        others.append(f"ledger {card.ledger[:16] or 'none'}, now that of {folder}")
    elif not any(others) and (now := taught(lived).card.hash) != card.hash:
        others.append(f"samples {card.hash[:16]} of the same ledger, now {now[:16]}")
    return "; ".join(filter(None, others))


def _of_day(card: DatasetCard, day: Path) -> bool:
    """Whether the data set of `card` was read from the ledger of `day`."""
    with LedgerReader(day / LEDGER) as ledger:
        return goes_on_from(ledger, Head(card.event, card.ledger))
