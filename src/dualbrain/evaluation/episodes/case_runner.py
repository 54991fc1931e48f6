"""One episode of one method: the loop of `runtime.episode` with the method's switches, watched from all sides."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import TYPE_CHECKING

import msgspec
import numpy as np

from dualbrain.contracts.contract import Contract
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.gate.gate import Gate
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ExecutorConfig, TickSnapshot
from dualbrain.control.gatekeeper.remote_executor import RemoteGate
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.evaluation.analysis.failure_taxonomy import TIME_LIMIT_REASON
from dualbrain.evaluation.episodes.wall_time import HOLD_TIME, PLANNER_TIME, UNCONSTRAINED_TIME, Stopwatch
from dualbrain.evaluation.protocol.baselines import BaselineGate, NoMemory, PassiveFilter
from dualbrain.evaluation.protocol.case import Case
from dualbrain.evaluation.protocol.method import Method
from dualbrain.grounding.vocabulary import planner_grants, scene_names
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.planner.prompt.full_prompt import MAX_RECALLED
from dualbrain.planner.protocol import Planner
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Episode, Outcome, Proposal
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.runtime.episode import ContractGate, EpisodeRequest, EpisodicMemory, GroundTruth, run_episode
from dualbrain.runtime.planning_time import PLANNING_TIME, PlanningClock
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.plant.factory import make_plant
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
    """What an episode left in memory: the record, the ticks, the whole gate's verdicts, time by part, the plant."""

    episode: Episode
    trace: Trace
    gate: BaselineGate
    stopwatch: Stopwatch
    plant: Plant
    goal_perception_error: tuple[float, float] | None
    """Perception error and its bound of the goal's thing when the contract was accepted [m]."""


@dataclass(frozen=True, slots=True, kw_only=True)
class EpisodeResources:
    """What an episode is flown with. `now` [s, 1970 UTC] stamps what memory writes; `clock` only measures."""

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
    """Asked the first question, too, with nothing that binds its answer; what it says is judged and goes nowhere."""


class TimeLimitedExecutor(ContractExecutor):
    """A local layer whose contracts have a time limit, known to the robot: what is not done by then has failed."""

    time_limit = float("inf")

    def execute(self, contract: Contract) -> Outcome:
        """As ever, but an end by the clock is the robot's own failure, not a person's word."""
        outcome = super().execute(contract)
        if outcome.kind == "aborted" and self.state.stamp >= self.time_limit:
            why = f"{TIME_LIMIT_REASON}, {self.time_limit:.0f} s"
            return msgspec.structs.replace(outcome, kind="failed", reason=why)
        return outcome


@cache
def load_cached_robot(robot: str) -> RobotModel:
    """The body, loaded once a process."""
    return load_robot(robot)


def run_case(case: Case, method: Method, resources: EpisodeResources) -> EpisodeRun:
    """Carry the instruction of `case` through the loop as `method` does."""
    stopwatch = Stopwatch(resources.clock)
    robot_model = load_cached_robot(case.robot)
    plant = make_plant(case.spec, robot_model, visuals=resources.visuals)
    perception = make_perception(case, method, plant)
    permitted = planner_grants(skill_registry(robot_model))[PLANNER]
    world = SimulatedWorld(plant, perception, goal=case.goal, permitted_skills=permitted)
    safety = SafetyFilter(robot_model) if method.guard else PassiveFilter(robot_model)
    log = FlightLog(Trace(robot_model.n, robot_model.nq))
    _time_parts(stopwatch, plant, world, safety)
    layer = TimeLimitedExecutor(
        robot_model,
        plant,
        world,
        safety,
        log,
        ExecutorConfig(guard=method.guard),
        on_tick=resources.on_tick,
        on_phase=world.set_phase,
        interrupted=lambda: plant.now >= case.time_limit,
    )
    layer.time_limit = case.time_limit
    stopwatch.time_method(layer, "hold", HOLD_TIME)
    doors: list[BaselineGate] = []
    seen: list[tuple[float, float]] = []

    def door(gate: Gate | RemoteGate) -> ContractGate:
        assert isinstance(gate, Gate)  # a local layer has its own
        doors.append(BaselineGate(method.gate, gate, skill_registry(robot_model)))
        return doors[0]

    def begin(contract: Contract) -> None:
        world.start_contract(contract)
        seen.extend(_goal_perception_error(case, layer, plant))

    def aside(request: PlanRequest) -> None:
        if resources.unconstrained_planner is not None and not doors[0].full_gate_verdicts:
            doors[0].unconstrained_answer = stopwatch.wrap(resources.unconstrained_planner.propose, UNCONSTRAINED_TIME)(
                request
            )

    errand = EpisodeRequest(
        id=resources.id,
        started="",
        instruction=case.instruction,
        seed=case.seed,
        max_shots=resources.max_shots,
        max_exemplars=MAX_RECALLED if method.uses_memory else 0,
    )
    witness = GroundTruth(begin, world.judgement, {}, lambda: resources.image_features(plant))
    experience = NoMemory() if resources.memory is None else resources.memory  # an empty memory is false, and one
    thinking = PlanningClock(resources.clock, planning_time=resources.planning_time)
    try:
        episode, _ = run_episode(
            errand,
            _TimedPlanner(resources.planner, stopwatch, aside),
            experience,
            layer,
            thinking,
            witness,
            lambda episode: None,
            now=resources.now,
            wrap_gate=door,
        )
        doors[0].check_unconstrained_answer(scene_names(layer.scene), PLANNER, layer.state.stamp)
    finally:
        plant.stop()
        perception.close()
    return EpisodeRun(
        episode=episode,
        trace=log.trace,
        gate=doors[0],
        stopwatch=stopwatch,
        plant=plant,
        goal_perception_error=seen[0] if seen else None,
    )


def make_perception(case: Case, method: Method, plant: Plant) -> NoisyPerception | DepthPerception:
    """How `method` sees the scene of `case`; raises `InvalidSetup` where depth alone cannot show it."""
    rng = np.random.default_rng([case.seed, case.repetition, 1])
    if method.perception == "depth":
        from dualbrain.simulation.perception.depth_camera import DepthCamera  # noqa: PLC0415  (0.4 s of SciPy that one method needs)
        from dualbrain.simulation.perception.depth_perception import DepthPerception  # noqa: PLC0415

        return DepthPerception(case.spec, DepthCamera(plant, rng=rng))
    return NoisyPerception(case.spec, PerceptionNoise(), rng)


class _TimedPlanner:
    """A planner whose time is measured beside the loop's; `aside` hears every question first."""

    def __init__(self, planner: Planner, stopwatch: Stopwatch, aside: Callable[[PlanRequest], None]) -> None:
        self._planner, self._before_propose = planner, aside
        self._propose = stopwatch.wrap(planner.propose, PLANNER_TIME)

    def propose(self, request: PlanRequest) -> Proposal:
        """The planner's answer."""
        self._before_propose(request)
        return self._propose(request)

    @property
    def name(self) -> str:
        return self._planner.name

    def close(self) -> None:
        """The planner is the caller's."""


def _time_parts(stopwatch: Stopwatch, plant: Plant, world: SimulatedWorld, safety: SafetyFilter) -> None:
    stopwatch.time_method(plant, "step", "physics")
    stopwatch.time_method(world.monitor, "update", "monitor")
    stopwatch.time_method(safety, "filter", "filter", keep_each=True)


def _goal_perception_error(case: Case, layer: ContractExecutor, plant: Plant) -> list[tuple[float, float]]:
    """Error and bound of the goal's thing as the layer believes it to lie; nothing where the goal is a place."""
    if not isinstance(case.goal, PlacementGoal):
        return []
    thing = next((one for one in layer.scene.objects if one.name == case.goal.object_name), None)
    if thing is None:
        return [(float("inf"), 0.0)]
    away = np.subtract(thing.pose.position, plant.true_pose(case.goal.object_name).position)
    return [(float(np.linalg.norm(away)), thing.error)]
