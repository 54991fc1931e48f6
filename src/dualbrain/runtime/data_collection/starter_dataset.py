"""The starter data set of starter-135m: training data from rollouts of randomly drawn contracts.

Synthetic examples are drawn by seed and executed in their scenes with the filter on. An executed action is training
data if the robot's own verdict is success and Δ is small, and for no other reason. A decline has no such evidence,
because nothing moves: it is training data if its example was drawn as infeasible or forbidden. Declines are executed
and stored in the ledger, too.

The adapter starts from base-135m. With the same samples and the bare model, 16 instead of 36 of 60 held-out
instructions were answered correctly (docs/results/LOG.md).
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
from dualbrain.memory.ledger.anchors import descends_from
from dualbrain.memory.ledger.hash_chain import Head
from dualbrain.memory.ledger.ledger import LedgerReader
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
"""Seed and number of the proposals: about one in eight is a decline, and about half of the others are training data."""
SUCCESSES_PER_DECLINE = 5
"""The training data has at most one decline for this number of successes."""
ADAPT_CONFIG = AdaptConfig(
    curation=CurationConfig(rules=CleanRules(epsilon=EPSILON)),
    fit=FitConfig(steps=150, batch=8, at_once=4, save_every=10, ask_at_most=0, patience=15, threads=1),
)
"""Settings of the adaptation. Checks use the loss only, because free answers take as long as twenty steps."""


def collect_rollouts(folder: Path, number: int, *, cache: Path, on_episode: Callable[[int, Episode], None]) -> Path:
    """Execute `number` proposals (see `run_proposals`); the same ones are drawn in every call."""
    proposals = draw_proposals(SEED, number, include_declines=True)
    return run_proposals(folder, number, proposals.__getitem__, cache=cache, on_episode=on_episode)


def build_dataset(rollouts: Path) -> Dataset:
    """The training data in the folder `rollouts`; raises `ConfigurationError` if no rollout succeeded."""
    registry, settings = load_skill_registry(ROBOT), ADAPT_CONFIG.curation
    with LedgerReader(rollouts / LEDGER_FILE) as ledger:
        successes = curate(ledger, registry, settings)
        max_declines = (len(successes.train) + len(successes.held_out)) // SUCCESSES_PER_DECLINE
        declined = (turn for turn, one in enumerate(load_proposals(rollouts)) if is_declined(one))
        declines = [memory_id_of_turn(turn) for turn in declined][:max_declines]
        return assemble_dataset(curate(ledger, registry, settings, declines=declines), registry, settings)


def dataset_difference(card: DatasetCard, folder: Path, number: int) -> str:
    """How the data set of `card` differs from that of `number` rollouts in `folder`; "" if it does not.

    The comparison uses the current skill registry, prompt and settings, the ledger of the rollouts, and the current
    selection and split of the training data.
    """
    registry = load_skill_registry(ROBOT)
    current: dict[str, object] = {
        "form": SAMPLE_FORMAT,
        "robot": ROBOT,
        "registry": registry.hash,
        "also": {},
        "site": "",
        "memories": number,
    }
    differences = [card_differences(card, current), curation_differences(card, ADAPT_CONFIG.curation)]
    rollouts = last_step_folder(folder)
    if rollouts is None or not _is_from_ledger(card, rollouts):
        differences.append(f"ledger {card.ledger[:16] or 'none'}, now that of {folder}")
    elif not any(differences) and (now := build_dataset(rollouts).card.hash) != card.hash:
        differences.append(f"samples {card.hash[:16]} of the same ledger, now {now[:16]}")
    return "; ".join(filter(None, differences))


def _is_from_ledger(card: DatasetCard, rollouts: Path) -> bool:
    """Whether the data set of `card` was made from the ledger in the folder `rollouts`."""
    with LedgerReader(rollouts / LEDGER_FILE) as ledger:
        return descends_from(ledger, Head(card.event, card.ledger))
