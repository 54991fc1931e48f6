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
from dualbrain.control.contract_executor import LocalLayer
from dualbrain.control.control_loop import LayerConfig, Moment
from dualbrain.control.gatekeeper.remote_executor import RemoteGate
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.evaluation.analysis.failure_taxonomy import OUT_OF_TIME
from dualbrain.evaluation.episodes.wall_time import ASIDE, ASKED, HOLD, Stopwatch
from dualbrain.evaluation.protocol.baselines import Forgetful, MethodDoor, UnheededFilter
from dualbrain.evaluation.protocol.case import Case
from dualbrain.evaluation.protocol.method import Method
from dualbrain.grounding.vocabulary import grants, scene_names
from dualbrain.memory.embedding.image_features import Picture
from dualbrain.planner.prompt.full_prompt import MAX_RECALLED
from dualbrain.planner.protocol import Planner
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Episode, Outcome, Proposal
from dualbrain.robots.loader import load_body
from dualbrain.robots.model import Body
from dualbrain.runtime.episode import Door, Errand, Experience, Witness, run_episode
from dualbrain.runtime.planning_time import PLANNING_TIME, Thinking
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.perception.noisy_perception import Noise, Perception
from dualbrain.simulation.plant.factory import open_plant
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.tasks.placement import Goal
from dualbrain.simulation.world import SimulatedWorld
from dualbrain.skills.registry import registry_of

if TYPE_CHECKING:
    from dualbrain.simulation.perception.depth_perception import DepthPerception

Clock = Callable[[], float]
PARTS = ("physics", "monitor", "filter", ASKED, "rest")


@dataclass(frozen=True, slots=True)
class Flight:
    """What an episode left in memory: the record, the ticks, the whole gate's verdicts, time by part, the plant."""

    episode: Episode
    trace: Trace
    door: MethodDoor
    stopwatch: Stopwatch
    plant: Plant
    seen: tuple[float, float] | None
    """Perception error and its bound of the goal's thing when the contract was accepted [m]."""


@dataclass(frozen=True, slots=True)
class Means:
    """What an episode is flown with. `now` [s, 1970 UTC] stamps what memory writes; `clock` only measures."""

    id: str
    planner: Planner
    clock: Clock
    experience: Experience | None = None
    now: float = 0.0
    shots: int = 1
    planning_time: float = PLANNING_TIME
    watch: Callable[[Moment], None] | None = None
    picture: Callable[[Plant], Picture | None] = lambda plant: None
    visuals: bool = False
    unbound: Planner | None = None
    """Asked the first question, too, with nothing that binds its answer; what it says is judged and goes nowhere."""


class TimedLayer(LocalLayer):
    """A local layer whose contracts have a time limit, known to the robot: what is not done by then has failed."""

    limit = float("inf")

    def run(self, contract: Contract) -> Outcome:
        """As ever, but an end by the clock is the robot's own failure, not a person's word."""
        outcome = super().run(contract)
        if outcome.kind == "aborted" and self.state.stamp >= self.limit:
            why = f"{OUT_OF_TIME}, {self.limit:.0f} s"
            return msgspec.structs.replace(outcome, kind="failed", reason=why)
        return outcome


@cache
def body_of(robot: str) -> Body:
    """The body, loaded once a process."""
    return load_body(robot)


def fly(case: Case, method: Method, means: Means) -> Flight:
    """Carry the instruction of `case` through the loop as `method` does."""
    stopwatch = Stopwatch(means.clock)
    body = body_of(case.robot)
    plant = open_plant(case.spec, body, visuals=means.visuals)
    perception = eyes(case, method, plant)
    permitted = grants(registry_of(body))[PLANNER]
    world = SimulatedWorld(plant, perception, goal=case.goal, permitted=permitted)
    safety = SafetyFilter(body) if method.guard else UnheededFilter(body)
    log = FlightLog(Trace(body.n, body.width))
    _measure(stopwatch, plant, world, safety)
    layer = TimedLayer(
        body, plant, world, safety, log, LayerConfig(guard=method.guard), watch=means.watch,
        phase_changed=world.allow, interrupted=lambda: plant.now >= case.time_limit,
    )  # fmt: skip
    layer.limit = case.time_limit
    stopwatch.watch(layer, "hold", HOLD)
    doors: list[MethodDoor] = []
    seen: list[tuple[float, float]] = []

    def door(gate: Gate | RemoteGate) -> Door:
        assert isinstance(gate, Gate)  # a local layer has its own
        doors.append(MethodDoor(method.door, gate, registry_of(body)))
        return doors[0]

    def begin(contract: Contract) -> None:
        world.begin(contract)
        seen.extend(_perceived(case, layer, plant))

    def aside(request: PlanRequest) -> None:
        if means.unbound is not None and not doors[0].strict:
            doors[0].aside = stopwatch.wrap(means.unbound.propose, ASIDE)(request)

    errand = Errand(
        means.id, "", case.instruction, case.seed, means.shots, exemplars=MAX_RECALLED if method.remembers else 0
    )  # fmt: skip
    witness = Witness(begin, world.judgement, {}, lambda: means.picture(plant))
    experience = Forgetful() if means.experience is None else means.experience  # an empty memory is false, and one
    thinking = Thinking(means.clock, planning_time=means.planning_time)
    try:
        episode, _ = run_episode(
            errand, _Watched(means.planner, stopwatch, aside), experience, layer, thinking, witness,
            lambda episode: None, now=means.now, door=door,
        )  # fmt: skip
        doors[0].look_aside(scene_names(layer.scene), PLANNER, layer.state.stamp)
    finally:
        plant.stop()
        perception.close()
    return Flight(episode, log.trace, doors[0], stopwatch, plant, seen[0] if seen else None)


def eyes(case: Case, method: Method, plant: Plant) -> Perception | DepthPerception:
    """How `method` sees the scene of `case`; raises `InvalidSetup` where depth alone cannot show it."""
    rng = np.random.default_rng([case.seed, case.repetition, 1])
    if method.eyes == "depth":
        from dualbrain.simulation.perception.depth_camera import DepthCamera  # noqa: PLC0415  (0.4 s of SciPy that one method needs)
        from dualbrain.simulation.perception.depth_perception import DepthPerception  # noqa: PLC0415

        return DepthPerception(case.spec, DepthCamera(plant, rng=rng))
    return Perception(case.spec, Noise(), rng)


class _Watched:
    """A planner whose time is measured beside the loop's; `aside` hears every question first."""

    def __init__(self, planner: Planner, stopwatch: Stopwatch, aside: Callable[[PlanRequest], None]) -> None:
        self._planner, self._aside = planner, aside
        self._propose = stopwatch.wrap(planner.propose, ASKED)

    def propose(self, request: PlanRequest) -> Proposal:
        """The planner's answer."""
        self._aside(request)
        return self._propose(request)

    @property
    def name(self) -> str:
        return self._planner.name

    def close(self) -> None:
        """The planner is the caller's."""


def _measure(stopwatch: Stopwatch, plant: Plant, world: SimulatedWorld, safety: SafetyFilter) -> None:
    stopwatch.watch(plant, "step", "physics")
    stopwatch.watch(world.monitor, "tick", "monitor")
    stopwatch.watch(safety, "filter", "filter", each=True)


def _perceived(case: Case, layer: LocalLayer, plant: Plant) -> list[tuple[float, float]]:
    """Error and bound of the goal's thing as the layer believes it to lie; nothing where the goal is a place."""
    if not isinstance(case.goal, Goal):
        return []
    thing = next((one for one in layer.scene.objects if one.name == case.goal.thing), None)
    if thing is None:
        return [(float("inf"), 0.0)]
    away = np.subtract(thing.pose.position, plant.truth(case.goal.thing).position)
    return [(float(np.linalg.norm(away)), thing.error)]
