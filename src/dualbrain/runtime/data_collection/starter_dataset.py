"""The starter data set of starter-135m: one cycle of exploration with a Panda (see `exploration/cycle.py`).

An executed contract is training data if the robot's own verdict is success, its senses confirm it, and Δ is small.
Rehearsal examples, among them declines, have no such evidence: the gate accepts them, and nothing is executed.

The adapter starts from base-135m. Trained on random contracts with the bare model, 16 instead of 36 of 60 held-out
instructions were answered correctly (docs/results/LOG.md).
"""

from __future__ import annotations

from pathlib import Path

from dualbrain.adaptation.config import AdaptConfig, FitConfig
from dualbrain.adaptation.curation.curate import CurationConfig
from dualbrain.adaptation.curation.dataset import SAMPLE_FORMAT, DatasetCard, card_differences
from dualbrain.adaptation.curation.selection import CleanRules
from dualbrain.errors import MissingDependencyError
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.runtime.data_collection.exploration.cycle import CycleConfig, build_cycle_dataset
from dualbrain.runtime.data_collection.exploration.training_set import TrainingSetConfig
from dualbrain.runtime.data_collection.rollouts import EPSILON, ROBOT

BASE_MODEL = "base-135m"
CYCLE = CycleConfig(
    robot=ROBOT,
    explored_seed=1,
    explored=120,
    executed_seeds=(103, 104),
    executions=200,
    training_set=TrainingSetConfig(wordings=8),
    adapt=AdaptConfig(
        curation=CurationConfig(rules=CleanRules(epsilon=EPSILON)),
        fit=FitConfig(steps=300, batch=16, at_once=16, save_every=100, ask_at_most=0, keep="last", threads=1),
    ),
)
"""Settings of the cycle. The last adapter is kept, and no question is asked during training."""


def dataset_difference(card: DatasetCard, folder: Path) -> str:
    """How the data set of `card` differs from that of the executions in `folder`; "" if it does not.

    The comparison uses the present skill registry, prompt and settings.
    """
    registry = load_skill_registry(ROBOT)
    expected = {"form": SAMPLE_FORMAT, "robot": ROBOT, "registry": registry.hash, "scene_values": True, "site": ""}
    if differences := card_differences(card, expected):
        return differences
    try:
        now = build_cycle_dataset(CYCLE, folder).card.hash
    except MissingDependencyError as error:
        return str(error)
    return "" if now == card.hash else f"samples {card.hash[:16]}, now {now[:16]}"
