"""Who plans where nobody is named: the small planner that comes with dualbrain, for the robot that it knows."""

from __future__ import annotations

from dualbrain.adaptation.adapter_card import read_adapter_card
from dualbrain.adaptation.serving.fitness import vocabularies
from dualbrain.adaptation.serving.packaged import packaged_folder
from dualbrain.planner.registry import LARGE_PLANNER

STARTER = "starter-135m"


def default_planner(robot: str) -> str:
    """`starter-135m` for the robots that it was taught, else the model that is told everything in its prompt.

    Measured by proof `starter` (docs/proofs.md): at a table it is right more often, in a fraction of the time.
    """
    taught = vocabularies(read_adapter_card(packaged_folder(STARTER)))
    return STARTER if robot in taught else LARGE_PLANNER
