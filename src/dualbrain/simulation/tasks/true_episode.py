"""The true beginning and end of an episode as exact scenes, for a judge of its instruction; for evaluation only."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.records import Scene
from dualbrain.robots.model import RobotModel
from dualbrain.simulation.monitoring.contact_rules import ContactRules
from dualbrain.simulation.perception.noisy_perception import NO_NOISE, NoisyPerception
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.tasks.placement import count_touching_fingers, is_static

FINGERS = 2


class InstructionVerdict(msgspec.Struct, frozen=True):
    """Whether an instruction was carried out on ground truth, None if it cannot be judged; `reason` is a sentence."""

    success: bool | None
    reason: str


@dataclass(frozen=True, slots=True, kw_only=True)
class TrueEpisode:
    """Exact scenes before and after, the configurations (nq,) of the robot, and contacts of the fingers at the end.

    `in_hand` is an object between both fingers, `in_hand_before` the one at the beginning, `touched` are all that a
    finger touches, `unsettled` those that move.
    """

    robot_model: RobotModel
    before: Scene
    after: Scene
    q_before: NDArray[np.float64]
    q_after: NDArray[np.float64]
    in_hand: str
    touched: frozenset[str]
    unsettled: frozenset[str]
    broken: frozenset[str]
    in_hand_before: str = ""


InstructionJudge = Callable[[TrueEpisode], InstructionVerdict]
"""Judges one instruction; `grounding.outcome.instruction_truth.make_instruction_judge` makes it from the words."""


class TrueEpisodeRecorder:
    """Records the exact state of a plant at the beginning, and makes the `TrueEpisode` at the end."""

    def __init__(self, plant: Plant) -> None:
        """Record the state of `plant`."""
        self._plant = plant
        self._rules = ContactRules(plant.model, plant.spec)
        self._before, self._q_before = exact_scene(plant), plant.configuration()
        self._in_hand_before = _object_in_hand(self._count_touching_fingers())

    def finish(self, broken: frozenset[str]) -> TrueEpisode:
        """The episode until now, with the `broken` objects."""
        plant, touching = self._plant, self._count_touching_fingers()
        return TrueEpisode(
            robot_model=plant.robot_model,
            before=self._before,
            after=exact_scene(plant),
            q_before=self._q_before,
            q_after=plant.configuration(),
            in_hand=_object_in_hand(touching),
            touched=frozenset(name for name, count in touching.items() if count),
            unsettled=frozenset(name for name in touching if not touching[name] and not is_static(plant, name)),
            broken=broken,
            in_hand_before=self._in_hand_before,
        )

    def _count_touching_fingers(self) -> dict[str, int]:
        """The number of fingers that touch each free object."""
        objects = [obj.name for obj in self._plant.spec.objects if obj.role == "object" and not obj.fixed]
        return {name: count_touching_fingers(self._plant, self._rules, name) for name in objects}


def _object_in_hand(touching: Mapping[str, int]) -> str:
    return next((name for name, count in touching.items() if count == FINGERS), "")


def exact_scene(plant: Plant) -> Scene:
    """The scene of `plant` without errors of perception."""
    return NoisyPerception(plant.spec, NO_NOISE, np.random.default_rng(0)).perceive(plant)
