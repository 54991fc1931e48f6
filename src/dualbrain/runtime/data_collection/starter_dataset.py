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

from dualbrain.adaptation.config import AdaptConfig, FitConfig
from dualbrain.adaptation.curation.curate import CurationConfig, curate
from dualbrain.adaptation.curation.dataset import (
    SAMPLE_FORMAT,
    Dataset,
    DatasetCard,
    assemble_dataset,
    card_differences,
    curation_differences,
)
from dualbrain.adaptation.curation.selection import CleanRules
from dualbrain.core.storage.resumable_steps import last_step_folder
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.memory.ledger.hash_chain import Head
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.state.history import descends_from
from dualbrain.records import Episode
from dualbrain.runtime.data_collection.rollouts import (
    EPSILON,
    LEDGER_FILE,
    ROBOT,
    draw_proposals,
    is_declined,
    load_proposals,
    memory_id_of_turn,
    run_proposals,
)

BASE_MODEL = "base-135m"
SEED, N_PROPOSALS = 900, 1400
"""Of the proposals about one in eight is to be declined; the others are flights, and about half of them teach."""
SUCCESSES_PER_DECLINE = 5
"""At most one decline for so many deeds is taught."""
ADAPT_CONFIG = AdaptConfig(
    curation=CurationConfig(rules=CleanRules(epsilon=EPSILON)),
    fit=FitConfig(steps=150, batch=8, at_once=4, save_every=10, ask_at_most=0, patience=15, threads=1),
)
"""The whole objective. Checked by the loss alone, for free answers take as long as twenty steps."""


def collect_rollouts(folder: Path, number: int, *, cache: Path, on_episode: Callable[[int, Episode], None]) -> Path:
    """`number` proposals carried out, see `flown`; the same ones whenever they are drawn again."""
    wanted = draw_proposals(SEED, number, include_declines=True)
    return run_proposals(folder, number, wanted.__getitem__, cache=cache, on_episode=on_episode)


def build_dataset(rollouts: Path) -> Dataset:
    """What the day in the folder `day` teaches; raises `InvalidSetup` if no deed in it went well."""
    registry, dials = load_skill_registry(ROBOT), ADAPT_CONFIG.curation
    with LedgerReader(rollouts / LEDGER_FILE) as ledger:
        deeds = curate(ledger, registry, dials)
        most = (len(deeds.train) + len(deeds.held_out)) // SUCCESSES_PER_DECLINE
        declines = [memory_id_of_turn(turn) for turn, one in enumerate(load_proposals(rollouts)) if is_declined(one)][
            :most
        ]
        return assemble_dataset(curate(ledger, registry, dials, declines=declines), registry, dials)


def dataset_difference(card: DatasetCard, folder: Path, number: int) -> str:
    """In what the data set of `card` is another than that of a day of `number` proposals in `folder`; "" if in none.

    The vocabulary, the prompt and the dials are those of today, the ledger is the day's, and what teaches there and on
    which side of the split is chosen as it would be today.
    """
    registry = load_skill_registry(ROBOT)
    made: dict[str, object] = {
        "form": SAMPLE_FORMAT,
        "robot": ROBOT,
        "registry": registry.hash,
        "also": {},
        "site": "",
        "memories": number,
    }
    others = [card_differences(card, made), curation_differences(card, ADAPT_CONFIG.curation)]
    lived = last_step_folder(folder)
    if lived is None or not _is_from_ledger(card, lived):
        others.append(f"ledger {card.ledger[:16] or 'none'}, now that of {folder}")
    elif not any(others) and (now := build_dataset(lived).card.hash) != card.hash:
        others.append(f"samples {card.hash[:16]} of the same ledger, now {now[:16]}")
    return "; ".join(filter(None, others))


def _is_from_ledger(card: DatasetCard, day: Path) -> bool:
    """Whether the data set of `card` was read from the ledger of `day`."""
    with LedgerReader(day / LEDGER_FILE) as ledger:
        return descends_from(ledger, Head(card.event, card.ledger))
