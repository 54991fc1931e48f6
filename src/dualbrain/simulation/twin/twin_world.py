"""The world of a kinematic twin: perception and time, without monitors and judges.

The twin has no contacts and no forces, so nothing in it can be judged on ground truth: the only verdict is the robot's
own.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from dualbrain.contracts.contract import Contract
from dualbrain.records import Judgement, JudgementBasis, Scene
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.twin.twin_plant import TwinPlant
from dualbrain.simulation.world import PerceptionModel

NOT_JUDGED = "A kinematic twin has no ground truth of contacts and forces."


class TwinWorld:
    """A twin seen through a perception model with the declared noise, drawn from `seed`."""

    def __init__(
        self, plant: TwinPlant, *, seed: int = 0, perception: Callable[[Plant], PerceptionModel] | None = None
    ) -> None:
        """Perceive `plant` with `perception`, by default with the declared noise."""
        self.plant = plant
        self.perception: PerceptionModel = (
            perception(plant)
            if perception
            else NoisyPerception(plant.spec, PerceptionNoise(), np.random.default_rng([seed, 1]))
        )

    def perceive(self) -> Scene:
        """The scene as perceived now."""
        return self.perception.perceive(self.plant)

    def advance(self) -> None:
        """Move everything for one control period."""
        self.plant.step()

    def start_contract(self, contract: Contract) -> None:
        """Nothing: no goal is judged."""

    def set_phase(self, phase: str, roles: dict[str, str | None]) -> None:
        """Nothing: no contact is monitored."""

    def judgement(self) -> Judgement:
        """No verdict: see `NOT_JUDGED`."""
        return Judgement(False, 0.0, (), JudgementBasis(judged=False, reason=NOT_JUDGED))
