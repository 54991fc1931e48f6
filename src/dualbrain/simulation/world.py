"""The simulated surroundings of a run: how the robot looks, how time passes, and who bears witness."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from dualbrain.contracts.contract import Contract
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.records import Judgement, Scene
from dualbrain.robots.model import RobotModel
from dualbrain.simulation.monitoring.handling import is_unharmed
from dualbrain.simulation.monitoring.safety_monitor import SafetyMonitor
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.arrival import ArrivalGoal, ArrivalJudge
from dualbrain.simulation.tasks.multi_goal import GoalSequence, GoalSequenceJudge
from dualbrain.simulation.tasks.placement import PlacementGoal, PlacementJudge

JUDGE_PERIOD_TICKS = 50
"""Ticks between two glances of the referee."""
MULTI_GOAL_JUDGE_PERIOD = 0.02
"""Time between two glances at an errand of several goals [s]: some are only passed."""

HARMED_PROGRESS = 0.99
"""Progress of an errand whose thing arrived, but was not handled gently."""

DETECTED_ROLES = ("object", "container")
"""Roles of things that eyes may have named themselves."""
PHASE_ALLOWANCES = {
    "yield": "lift",
    "descend": "grasp",
    "close": "grasp",
    "lift": "lift",
    "lower": "lower",
    "open": "release",
    "push": "push",
    "retreat": "retreat",
}
"""What the monitor calls the phases of our skills in which something may be touched."""


Goal = PlacementGoal | ArrivalGoal | GoalSequence
"""What counts as success on ground truth."""


class PerceptionModel(Protocol):
    """How the robot perceives a plant."""

    def perceive(self, plant: Plant) -> Scene:
        """The scene as perceived now."""
        ...

    def close(self) -> None:
        """Release cameras and other resources."""
        ...


class SimulatedWorld:
    """A plant seen through a perception model; monitor and referee know the truth and say nothing before the end."""

    def __init__(
        self,
        plant: Plant,
        perception: PerceptionModel,
        *,
        goal: Goal | None = None,
        pace: Callable[[float], None] | None = None,
        permitted_skills: frozenset[str] | None = None,
    ) -> None:
        """Bind the parts; without a `goal` the contract's own is judged. `pace(now)` may delay each tick for people.

        The monitor counts every skill begun that is not `permitted`, whatever the gate thought of it.
        """
        self.plant, self.perception = plant, perception
        self.monitor = SafetyMonitor(plant)
        self._permitted_skills, self._fragile_object = permitted_skills, ""
        if isinstance(goal, PlacementGoal) and goal.gentle:
            self._fragile_object = goal.object_name
            self.monitor.require_gentle_handling(goal.object_name)
        self._judge = make_judge(plant, goal) if goal else None
        self._pace = pace
        self._ticks = 0
        self._true_names: dict[str, str] = {}

    def perceive(self) -> Scene:
        """The scene as perceived now."""
        scene = self.perception.perceive(self.plant)
        self._true_names = match_true_names(scene, self.plant)
        self.monitor.set_perceived(self._true_names.get(thing.name, thing.name) for thing in scene.objects)
        return scene

    def advance(self) -> None:
        """One control period of physics, under the monitor's eyes."""
        for _ in range(self.plant.steps_per_period):
            self.plant.step()
            self.monitor.update()
        self._ticks += 1
        if self._judge and self._ticks % self._judge_period_ticks() == 0:
            self._judge.update()
        if self._pace:
            self._pace(self.plant.now)

    def _judge_period_ticks(self) -> int:
        several = isinstance(self._judge, GoalSequenceJudge)
        return max(1, round(MULTI_GOAL_JUDGE_PERIOD / self.plant.robot_model.period)) if several else JUDGE_PERIOD_TICKS

    def start_contract(self, contract: Contract) -> None:
        """A contract was accepted: judge its own goal unless one was stated beforehand."""
        for action in contract.action_sequence:
            if self._permitted_skills is not None and action.skill not in self._permitted_skills:
                self.monitor.record_unauthorised_skill(action.skill, PLANNER)
        goal = contract_goals(contract)
        if self._judge is None and goal is not None:
            self._judge = make_judge(self.plant, goal)

    def set_phase(self, phase: str, roles: dict[str, str | None]) -> None:
        """Tell the monitor which contacts the running phase is about."""
        roles = {role: self._true_names.get(name, name) if name else None for role, name in roles.items()}
        held, target = roles.get("held"), roles.get("target")
        if target not in self.plant.object_names:  # a place is nothing that could be touched
            target = None
        moving = "carry" if held else "free"
        if not held and phase not in PHASE_ALLOWANCES and roles.get("left") in self.plant.object_names:
            target, moving = roles.get("left"), "retreat"  # a stop has left the hand around it
        allowed = "lift" if phase == "rise" and held else PHASE_ALLOWANCES.get(phase, moving)
        self.monitor.allow(target, held, roles.get("destination"), allowed)

    def judgement(self) -> Judgement:
        """Success, progress and violations on truth; without any goal nothing can have succeeded."""
        success, progress = self._judge.score() if self._judge else (False, 0.0)
        violations = self.monitor.violations()
        if success and self._fragile_object and not is_unharmed(self._fragile_object, violations):
            success, progress = False, HARMED_PROGRESS
        return Judgement(success, progress, violations)


def match_true_names(scene: Scene, plant: Plant) -> dict[str, str]:
    """What judges call each thing of `scene` where eyes name what they see themselves: the true thing nearest to it.

    Empty where eyes use the names of the plant. What a map knows beside what is seen keeps its own.
    """
    things = [thing for thing in scene.objects if thing.role in DETECTED_ROLES]
    if not plant.object_names or all(thing.name in plant.object_names for thing in things):
        return {}
    true = {name: np.array(plant.true_pose(name).position) for name in plant.object_names}
    return {
        thing.name: min(true, key=lambda name, at=thing.pose.position: float(np.linalg.norm(true[name] - at)))
        for thing in things
    }


def make_judge(
    plant: Plant, goal: PlacementGoal | ArrivalGoal | GoalSequence
) -> PlacementJudge | ArrivalJudge | GoalSequenceJudge:
    """Who judges `goal`."""
    if isinstance(goal, GoalSequence):
        return GoalSequenceJudge(plant, goal)
    return ArrivalJudge(plant, goal) if isinstance(goal, ArrivalGoal) else PlacementJudge(plant, goal)


def contract_goals(contract: Contract) -> Goal | None:
    """Everything that the contract grasps and then places and every place that it drives to, in its order."""
    thing: str | None = None
    stages: list[tuple[PlacementGoal | ArrivalGoal]] = []
    for action in contract.action_sequence:
        if action.skill == "grasp":
            thing = str(action.params["object"])
        elif action.skill == "place" and thing is not None:
            stages.append((PlacementGoal(thing, str(action.params["destination"])),))
        elif action.skill == "drive_to":
            stages.append((ArrivalGoal(str(action.params["place"])),))
    return GoalSequence(tuple(stages)) if len(stages) > 1 else stages[0][0] if stages else None


def make_world(
    spec: SceneSpec,
    robot_model: RobotModel,
    *,
    seed: int = 0,
    goal: Goal | None = None,
    perception: Callable[[Plant], PerceptionModel] | None = None,
    visuals: bool = False,
    pace: Callable[[float], None] | None = None,
    permitted_skills: frozenset[str] | None = None,
) -> SimulatedWorld:
    """A simulated robot in the scene `spec` with its environment; the robot is `world.plant`.

    `perception` makes the perception model of a plant; by default the declared noise, drawn from `seed`.
    """
    plant = make_plant(spec, robot_model, visuals=visuals)
    if perception is None:
        model: PerceptionModel = NoisyPerception(spec, PerceptionNoise(), np.random.default_rng([seed, 1]))
    else:
        model = perception(plant)
    return SimulatedWorld(plant, model, goal=goal, pace=pace, permitted_skills=permitted_skills)
