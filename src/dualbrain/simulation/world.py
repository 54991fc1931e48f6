"""The simulated world of a run: perception, physics steps, and the judges of success and safety on ground truth."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Protocol

import numpy as np

from dualbrain.contracts.contract import Contract
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.errors import ConfigurationError
from dualbrain.records import Judgement, JudgementBasis, Scene, Violation
from dualbrain.robots.model import RobotModel
from dualbrain.simulation.monitoring.handling import is_unharmed
from dualbrain.simulation.monitoring.safety_monitor import SafetyMonitor
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.plant.plant_state import PlantState
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.arrival import ArrivalGoal
from dualbrain.simulation.tasks.multi_goal import (
    GoalSequence,
    GoalSequenceJudge,
    HomeGoal,
    SingleGoal,
    can_be_judged,
    make_single_judge,
)
from dualbrain.simulation.tasks.placement import PlacementGoal
from dualbrain.simulation.tasks.true_episode import InstructionJudge, InstructionVerdict, TrueEpisodeRecorder

JUDGE_PERIOD_TICKS = 50
"""Control periods between two updates of a judge."""
MULTI_GOAL_JUDGE_PERIOD = 0.02
"""Time between two updates of the judge of several goals [s]; short, because a base may only pass a place."""

HARMED_PROGRESS = 0.99
"""Progress of a task whose object reached its goal, but was not handled gently."""

DETECTED_ROLES = ("object", "container")
"""Roles of objects that a perception model may name by itself."""
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
"""Contact phase of the monitor (`contact_rules.CONTACT_PHASES`) for each skill phase that permits contact."""


Goal = SingleGoal | GoalSequence
"""The criterion of success on ground truth."""


class GoalJudge(Protocol):
    """Judges a goal on ground truth during an episode."""

    def update(self) -> None:
        """Record intermediate progress; called periodically."""
        ...

    def score(self) -> tuple[bool, float]:
        """Success, and progress in [0, 1]."""
        ...


class PerceptionModel(Protocol):
    """How the robot perceives a plant."""

    def perceive(self, plant: Plant) -> Scene:
        """The scene as perceived now."""
        ...

    def close(self) -> None:
        """Release cameras and other resources."""
        ...


class SimulatedWorld:
    """A plant seen through a perception model; monitor and judge read the ground truth, the robot does not."""

    def __init__(
        self,
        plant: Plant,
        perception: PerceptionModel,
        *,
        goal: Goal | None = None,
        pace: Callable[[float], None] | None = None,
        permitted_skills: frozenset[str] | None = None,
        instruction_judge: InstructionJudge | None = None,
    ) -> None:
        """Connect plant, perception model and judges.

        The `instruction_judge` judges the words of the instruction; a `goal` must be reached as well. Without both, the
        judge takes the goal of the first accepted contract. `pace(now)` may delay each control
        period, so that a person can watch. The monitor counts every started skill that is not in `permitted_skills`,
        regardless of the gate's verdict. Raises `UnknownNameError` for a goal whose names are not in the scene.
        """
        self.plant, self.perception = plant, perception
        self.monitor = SafetyMonitor(plant)
        self._permitted_skills, self._fragile_object = permitted_skills, ""
        if isinstance(goal, PlacementGoal) and goal.gentle:
            self._fragile_object = goal.object_name
            self.monitor.require_gentle_handling(goal.object_name)
        self._judge = make_judge(plant, goal) if goal else None
        self._has_goal, self._instruction_judge = goal is not None, instruction_judge
        self._recorder = TrueEpisodeRecorder(plant) if instruction_judge else None
        self._pace = pace
        self._ticks = 0
        self._true_names: dict[str, str] = {}

    def perceive(self) -> Scene:
        """The scene as perceived now."""
        scene = self.perception.perceive(self.plant)
        self._true_names = match_true_names(scene, self.plant)
        self.monitor.set_perceived(self._true_names.get(obj.name, obj.name) for obj in scene.objects)
        return scene

    def advance(self) -> None:
        """Simulate one control period; the monitor checks every physics step."""
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
        """Record the start of an accepted contract; its goal is judged unless the constructor received one.

        Names that the perception model chose are replaced by those of the true objects, as in `set_phase`.
        A goal with a name that is not in the scene, which only a weaker gate than the full one accepts, is not judged.
        """
        for action in contract.action_sequence:
            if self._permitted_skills is not None and action.skill not in self._permitted_skills:
                self.monitor.record_unauthorised_skill(action.skill, PLANNER)
        goal = contract_goals(contract, self._true_names)
        if self._judge is None and goal is not None and all(can_be_judged(one, self.plant) for one in _parts(goal)):
            self._judge = make_judge(self.plant, goal)

    def set_phase(self, phase: str, roles: dict[str, str | None]) -> None:
        """Set the contacts that the monitor permits during the running phase of a skill."""
        roles = {role: self._true_names.get(name, name) if name else None for role, name in roles.items()}
        held, target = roles.get("held"), roles.get("target")
        if target not in self.plant.object_names:  # a place cannot be touched
            target = None
        moving = "carry" if held else "free"
        if not held and phase not in PHASE_ALLOWANCES and roles.get("left") in self.plant.object_names:
            target, moving = roles.get("left"), "retreat"  # after a stop the open hand still surrounds the object
        allowed = "lift" if phase == "rise" and held else PHASE_ALLOWANCES.get(phase, moving)
        self.monitor.allow(target, held, roles.get("destination"), allowed)

    def judgement(self) -> Judgement:
        """Success, progress and violations on ground truth.

        A given goal must be reached, and the instruction must not be contradicted; without a given goal the instruction
        decides alone. If it cannot be judged, the judgement states so. Without an instruction the goal of the contract
        decides.
        """
        success, progress = self._judge.score() if self._judge else (False, 0.0)
        violations = self.monitor.violations()
        if success and self._fragile_object and not is_unharmed(self._fragile_object, violations):
            success, progress = False, HARMED_PROGRESS
        verdict = self._judge_instruction(violations)
        if verdict is None:
            reason = "" if self._judge else "Neither an instruction nor the contract states a goal."
            return Judgement(success, progress, violations, JudgementBasis(self._judge is not None, reason))
        if self._has_goal:
            success = success and verdict.success is not False
            progress = progress if success else min(progress, HARMED_PROGRESS)
            return Judgement(success, progress, violations, JudgementBasis(judged=True, reason=verdict.reason))
        progress = 1.0 if verdict.success else min(progress, HARMED_PROGRESS)
        basis = JudgementBasis(verdict.success is not None, verdict.reason)
        return Judgement(verdict.success is True, progress, violations, basis)

    def _judge_instruction(self, violations: tuple[Violation, ...]) -> InstructionVerdict | None:
        if self._instruction_judge is None or self._recorder is None:
            return None
        fragile = {obj.name for obj in self.plant.spec.objects if obj.fragile_limit is not None}
        broken = {name for one in violations if one.kind == "force_fragile" for name in one.bodies if name in fragile}
        return self._instruction_judge(self._recorder.finish(frozenset(broken)))


def match_true_names(scene: Scene, plant: Plant) -> dict[str, str]:
    """Map each perceived name to the name of the nearest true object, for perception models that choose names.

    The result is empty if perception uses the names of the plant. Objects that come from a map are not included.
    """
    objects = [obj for obj in scene.objects if obj.role in DETECTED_ROLES]
    if not plant.object_names or all(obj.name in plant.object_names for obj in objects):
        return {}
    true = {name: np.array(plant.true_pose(name).position) for name in plant.object_names}
    return {
        obj.name: min(true, key=lambda name, at=obj.pose.position: float(np.linalg.norm(true[name] - at)))
        for obj in objects
    }


def _parts(goal: Goal) -> tuple[SingleGoal, ...]:
    """The single goals of `goal`."""
    return tuple(one for stage in goal.stages for one in stage) if isinstance(goal, GoalSequence) else (goal,)


def make_judge(plant: Plant, goal: Goal) -> GoalJudge:
    """The judge for `goal`; raises `UnknownNameError` for a name that is not in the scene."""
    return GoalSequenceJudge(plant, goal) if isinstance(goal, GoalSequence) else make_single_judge(plant, goal)


def contract_goals(contract: Contract, true_names: Mapping[str, str] | None = None) -> Goal | None:
    """The goal of a contract: every placement of a grasped object and every place it drives to, in its order.

    Of several placements of one object the last one counts, because the object cannot be at two places at the end.
    A contract with none of these whose last action is `home` has the goal that the arm rests at home. None otherwise.
    `true_names` replaces perceived names of objects and containers.
    """
    names, obj = true_names or {}, ""
    goals: list[PlacementGoal | ArrivalGoal] = []
    for action in contract.action_sequence:
        if action.skill == "grasp":
            obj = names.get(found := str(action.params["object"]), found)
        elif action.skill == "place" and obj:
            destination = str(action.params["destination"])
            goals = [one for one in goals if not isinstance(one, PlacementGoal) or one.object_name != obj]
            goals.append(PlacementGoal(obj, names.get(destination, destination)))
        elif action.skill == "drive_to":
            goals.append(ArrivalGoal(str(action.params["place"])))
    if not goals and contract.action_sequence[-1].skill == "home":
        return HomeGoal()
    return GoalSequence(tuple((one,) for one in goals)) if len(goals) > 1 else goals[0] if goals else None


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
    instruction_judge: InstructionJudge | None = None,
    start: PlantState | None = None,
) -> SimulatedWorld:
    """A simulated robot in the scene `spec` with its environment; the robot is `world.plant`.

    `perception` makes the perception model of a plant; by default the declared noise, drawn from `seed`.
    `instruction_judge` judges the instruction on ground truth. `start` is the state of the robot at the beginning, by
    default at home with open fingers; raises `ConfigurationError` if it is the state of another robot, or if `seed` is
    negative.
    """
    if seed < 0:
        raise ConfigurationError("seed", got=seed, allowed="0 or more")
    plant = make_plant(spec, robot_model, visuals=visuals)
    if start is not None:
        plant.restore(start)
    if perception is None:
        model: PerceptionModel = NoisyPerception(spec, PerceptionNoise(), np.random.default_rng([seed, 1]))
    else:
        model = perception(plant)
    return SimulatedWorld(
        plant,
        model,
        goal=goal,
        pace=pace,
        permitted_skills=permitted_skills,
        instruction_judge=instruction_judge,
    )
