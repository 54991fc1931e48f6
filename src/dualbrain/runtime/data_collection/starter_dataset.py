"""The starter data set of starter-135m: one cycle of exploration with a Panda (see `exploration/cycle.py`).

An executed contract is training data if the robot's own verdict is success, its senses confirm it, and Δ is small.
Rehearsal examples, among them declines, have no such evidence: the gate accepts them, and nothing is executed.

The adapter starts from base-135m. Trained on random contracts with the bare model, 16 instead of 36 of 60 held-out
instructions were answered correctly (docs/results/LOG.md).
"""

from __future__ import annotations

from dualbrain.adaptation.config import AdaptConfig, FitConfig
from dualbrain.adaptation.curation.curate import CurationConfig
from dualbrain.adaptation.curation.selection import CleanRules
from dualbrain.runtime.data_collection.exploration.cycle import CycleConfig
from dualbrain.runtime.data_collection.exploration.training_set import TrainingSetConfig
from dualbrain.runtime.data_collection.rollouts import EPSILON, ROBOT

BASE_MODEL = "base-135m"
CYCLE = CycleConfig(
    robot=ROBOT,
    explored_seed=1,
    explored=120,
    executed_seeds=(103, 104),
    executions=150,
    training_set=TrainingSetConfig(wordings=4),
    adapt=AdaptConfig(
        curation=CurationConfig(rules=CleanRules(epsilon=EPSILON)),
        fit=FitConfig(steps=70, batch=16, at_once=8, save_every=10, ask_at_most=0, keep="last", threads=1),
    ),
)
"""The last adapter is kept, and no question is asked during training."""
