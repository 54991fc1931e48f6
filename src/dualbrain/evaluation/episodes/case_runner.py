"""One episode of one method: the episode loop with the switches of the method, measured and judged."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import numpy as np

from dualbrain.contracts.contract import Contract
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ControlLoopConfig, LoopInputs, LoopObserver, TickSnapshot
from dualbrain.control.executor import Grants
from dualbrain.control.recording.trace import Trace
from dualbrain.evaluation.episodes.wall_time import HOLD_TIME, PLANNER_TIME, UNCONSTRAINED_TIME, Stopwatch
from dualbrain.evaluation.protocol.baselines import BaselineGate, PassiveFilter
from dualbrain.evaluation.protocol.case import Case
from dualbrain.evaluation.protocol.method import GateKind, Method
from dualbrain.grounding.vocabulary import planner_grants, scene_names
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.planner.prompt.full_prompt import MAX_RECALLED
from dualbrain.planner.protocol import Planner
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Episode, Proposal, Scene
from dualbrain.robots.interface import RobotState
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.runtime.agent import Agent, EpisodicMemory, NoMemory
from dualbrain.runtime.assembly import CellOptions, SimulatedCell, open_filter, open_world
from dualbrain.runtime.episode import GroundTruth, run_episode
from dualbrain.runtime.planning.episode_request import EpisodeRequest
from dualbrain.runtime.planning.planning_time import PLANNING_TIME, PlanningClock
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.monitoring.safety_monitor import SafetyMeasurements
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.tasks.placement import PlacementGoal
from dualbrain.simulation.world import SimulatedWorld
from dualbrain.skills.registry import skill_registry

if TYPE_CHECKING:
    from dualbrain.simulation.perception.depth_perception import DepthPerception

Clock = Callable[[], float]
WALL_TIME_PARTS = ("physics", "monitor", "filter", PLANNER_TIME, "rest")


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeRun:
    """The record of an episode, its trace, the verdicts of the gate, the wall time by part, and the final plant."""

    episode: Episode
    trace: Trace
    gate: BaselineGate
    stopwatch: Stopwatch
    plant: Plant
    measurements: SafetyMeasurements
    goal_perception_error: tuple[float, float] | None
    """Position error of the goal's object and its bound [m] when the contract was accepted."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeResources:
    """The parts of an episode that a worker provides.

    Memory stores the episode under `now` [s, 1970 UTC]; `clock` is only used for measurements.
    """

    id: str
    planner: Planner
    clock: Clock
    memory: EpisodicMemory | None = None
    now: float = 0.0
    max_shots: int = 1
    planning_time: float = PLANNING_TIME
    on_tick: Callable[[TickSnapshot], None] | None = None
    image_features: Callable[[Plant], ImageFeatures | None] = lambda plant: None
    visuals: bool = False
    unconstrained_planner: Planner | None = None
    """Answers the first request too, without constrained decoding; its answer is judged and not executed."""
    keep_margins: bool = True
    """`ControlLoopConfig.keep_margins`; False for comparisons."""
    target: str = ""
    """Emulated board on which the filter of a method runs, in lockstep; "" runs it in this process."""


class EvaluatedExecutor:
    """The executor of a cell behind the gate of a compared method; implements `Executor`.

    `stopwatch` measures how long the arm holds position during planning.
    """

    def __init__(self, executor: ContractExecutor, gate_kind: GateKind, stopwatch: Stopwatch) -> None:
        """Put the gate of a method in front of `executor`."""
        self._executor = executor
        self._gate_kind: GateKind = gate_kind
        self.hold = stopwatch.wrap(executor.hold, HOLD_TIME)
        self.execute, self.interrupted = executor.execute, executor.interrupted
        self.robot_model, self.log = executor.robot_model, executor.log
        self.baseline_gate: BaselineGate | None = None

    @property
    def scene(self) -> Scene:
        """The newest perceived scene."""
        return self._executor.scene

    @property
    def state(self) -> RobotState:
        """The newest joint state."""
        return self._executor.state

    @property
    def held_object(self) -> str | None:
        """The name of the object in the gripper, None if the gripper is empty."""
        return self._executor.held_object

    def gate(self, grants: Grants) -> BaselineGate:
        """The gate of the method, which also records the verdicts of the full gate."""
        registry = skill_registry(self.robot_model)
        self.baseline_gate = BaselineGate(self._gate_kind, self._executor.gate(grants), registry)
        return self.baseline_gate


@cache
def load_cached_robot(robot: str) -> RobotModel:
    """The robot model, loaded once per process."""
    return load_robot(robot)


def run_case(case: Case, method: Method, resources: EpisodeResources) -> EpisodeRun:
    """Run the instruction of `case` through the episode loop with the switches of `method`."""
    model = load_cached_robot(case.robot)
    if not method.guard:
        return _run_with_filter(case, method, resources, PassiveFilter(model))
    with open_filter(model, resources.target) as safety:
        return _run_with_filter(case, method, resources, safety)


def _run_with_filter(case: Case, method: Method, resources: EpisodeResources, safety: SafetyFilter) -> EpisodeRun:
    stopwatch = Stopwatch(resources.clock)
    cell = _make_cell(case, method, resources, stopwatch, safety)
    executor = EvaluatedExecutor(cell.executor, method.gate, stopwatch)
    errors: list[tuple[float, float]] = []

    def start_contract(contract: Contract) -> None:
        cell.world.start_contract(contract)
        errors.extend(_goal_perception_error(case, executor.scene, cell.plant))

    def before_propose(request: PlanRequest) -> None:
        gate, planner = executor.baseline_gate, resources.unconstrained_planner
        if planner is not None and gate is not None and not gate.full_gate_verdicts:
            gate.unconstrained_answer = stopwatch.wrap(planner.propose, UNCONSTRAINED_TIME)(request)

    request = EpisodeRequest(
        id=resources.id,
        started="",
        instruction=case.instruction,
        seed=case.seed,
        now=resources.now,
        max_shots=resources.max_shots,
        max_exemplars=MAX_RECALLED if method.uses_memory else 0,
        reuse_contracts=method.reuse_contracts,
        instruction_check="before_planning" if method.planner_role == "adversary" else "all",
    )
    memory = NoMemory() if resources.memory is None else resources.memory  # an empty memory is falsy
    agent = Agent(_TimedPlanner(resources.planner, stopwatch, before_propose), memory)
    clock = PlanningClock(resources.clock, planning_time=resources.planning_time)
    truth = GroundTruth(
        start_contract=start_contract,
        judge=cell.judgement,
        versions={},
        image_features=lambda: resources.image_features(cell.plant),
    )
    try:
        episode, _ = run_episode(request, agent, executor, clock, truth)
        gate = executor.baseline_gate
        assert gate is not None  # every episode passes the gate once
        gate.check_unconstrained_answer(scene_names(executor.scene), PLANNER, executor.state.stamp)
        if text := safety.describe_target():
            cell.log.note(executor.state.stamp, "target", text)
    finally:
        cell.close()
    assert isinstance(cell.world, SimulatedWorld)  # a case is judged on ground truth
    return EpisodeRun(
        episode=episode,
        trace=cell.log.trace,
        gate=gate,
        stopwatch=stopwatch,
        plant=cell.plant,
        measurements=cell.world.monitor.measurements(),
        goal_perception_error=errors[0] if errors else None,
    )


def _make_cell(
    case: Case, method: Method, resources: EpisodeResources, stopwatch: Stopwatch, safety: SafetyFilter
) -> SimulatedCell:
    """The cell of a case; the filter of an unfiltered method only measures."""
    model = safety.robot_model
    options = CellOptions(
        goal=case.goal,
        instruction=case.instruction,
        perception=lambda plant: make_perception(case, method, plant),
        visuals=resources.visuals,
        permitted_skills=planner_grants(skill_registry(model))[PLANNER],
    )
    world = open_world(case.spec, model, options)
    _time_parts(stopwatch, world, safety)
    return SimulatedCell(
        model,
        world,
        safety=safety,
        config=ControlLoopConfig(guard=method.guard, keep_margins=resources.keep_margins),
        observer=LoopObserver(on_tick=resources.on_tick),
        inputs=LoopInputs(interrupted=lambda: world.plant.now >= case.time_limit),
        time_limit=case.time_limit,
    )


def make_perception(case: Case, method: Method, plant: Plant) -> NoisyPerception | DepthPerception:
    """The perception model of `method`; raises `ConfigurationError` if depth images cannot show the scene."""
    rng = np.random.default_rng([case.seed, case.repetition, 1])
    if method.perception == "depth":
        from dualbrain.simulation.perception.depth_camera import DepthCamera  # noqa: PLC0415  (0.4 s of SciPy that one method needs)
        from dualbrain.simulation.perception.depth_perception import DepthPerception  # noqa: PLC0415

        return DepthPerception(case.spec, DepthCamera(plant, rng=rng))
    return NoisyPerception(case.spec, PerceptionNoise(), rng)


class _TimedPlanner:
    """A planner whose time is measured separately from that of the loop; `before_propose` gets every request first."""

    def __init__(self, planner: Planner, stopwatch: Stopwatch, before_propose: Callable[[PlanRequest], None]) -> None:
        self._planner, self._before_propose = planner, before_propose
        self._propose = stopwatch.wrap(planner.propose, PLANNER_TIME)

    def propose(self, request: PlanRequest) -> Proposal:
        """The planner's answer."""
        self._before_propose(request)
        return self._propose(request)

    @property
    def name(self) -> str:
        return self._planner.name

    def close(self) -> None:
        """The caller closes the planner."""


def _time_parts(stopwatch: Stopwatch, world: SimulatedWorld, safety: SafetyFilter) -> None:
    stopwatch.time_method(world.plant, "step", "physics")
    stopwatch.time_method(world.monitor, "update", "monitor")
    stopwatch.time_method(safety, "filter", "filter", keep_each=True)


def _goal_perception_error(case: Case, scene: Scene, plant: Plant) -> list[tuple[float, float]]:
    """Position error of the goal's object in `scene` and its bound [m]; empty where the goal is a place."""
    if not isinstance(case.goal, PlacementGoal):
        return []
    obj = next((one for one in scene.objects if one.name == case.goal.object_name), None)
    if obj is None:
        return [(float("inf"), 0.0)]
    error = np.subtract(obj.pose.position, plant.true_pose(case.goal.object_name).position)
    return [(float(np.linalg.norm(error)), obj.error)]
