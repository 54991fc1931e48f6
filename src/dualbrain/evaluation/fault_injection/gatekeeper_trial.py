"""A fault of planner or socket, injected in lockstep: the whole gatekeeper, its door and its gate around a plant."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.contracts.contract import Contract
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.control.gatekeeper.capability import full_capability
from dualbrain.control.gatekeeper.gatekeeper import Gatekeeper, GatekeeperSettings
from dualbrain.control.gatekeeper.protocol.authentication import load_or_create_keys
from dualbrain.control.gatekeeper.protocol.server import SocketServer
from dualbrain.control.recording.trace import Trace
from dualbrain.evaluation.fault_injection.faults import Fault, FaultInjector, FaultyRobot
from dualbrain.evaluation.fault_injection.faulty_client import FaultyCommander
from dualbrain.records import Outcome, Scene
from dualbrain.robots.interface import Command, RobotState
from dualbrain.robots.model import RobotModel
from dualbrain.safety.supervisor.timing import SIMULATED
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.world import SimulatedWorld, make_world
from dualbrain.skills.registry import skill_registry

MAX_EPISODE_TIME = 60.0
"""[s] after which an episode is given up."""
FORBIDDEN_SPEED = 3.0
"""A speed [m/s] that no gate lets through."""


@dataclass(kw_only=True)
class LockstepRobot:
    """A plant at the gatekeeper's wire: `each(now)` is called after every period."""

    robot: FaultyRobot
    world: SimulatedWorld
    plant: Plant
    injector: FaultInjector
    on_period: Callable[[float], None] = lambda now: None

    def read(self) -> RobotState:
        """The newest state."""
        return self.robot.read()

    def write(self, command: Command) -> None:
        """Hold `command`."""
        self.robot.write(command)

    def stop(self) -> None:
        """Brakes on."""
        self.robot.stop()

    def enable(self) -> None:
        """Brakes off."""
        self.robot.enable()

    def perceive(self) -> Scene:
        """The scene as perceived now."""
        return self.world.perceive()

    def advance(self) -> None:
        """One control period."""
        self.world.advance()
        self.on_period(self.plant.now)

    def clock(self) -> float:
        """Simulated time [s]."""
        return self.plant.now

    def conditions(self) -> int:
        """In lockstep nothing is late."""
        return 0

    def set_phase(self, phase: str, roles: dict[str, str | None]) -> None:
        """Tell monitor and injector."""
        self.world.set_phase(phase, roles)
        self.injector.set_phase(phase)

    def start_contract(self, contract: Contract) -> None:
        """Tell the referee."""
        self.world.start_contract(contract)


@dataclass(kw_only=True)
class GatekeeperTrialResult:
    """What one episode at the door led to."""

    plant: Plant
    world: SimulatedWorld
    injector: FaultInjector
    trace: Trace
    outcome: Outcome = field(default_factory=lambda: Outcome(kind="stopped", reason="it never began"))
    final_action: str = ""


def run_gatekeeper_trial(
    fault: Fault,
    robot_model: RobotModel,
    spec: SceneSpec,
    contract_actions: list[dict[str, Any]],
    seed: int,
    aftermath: float,
    on_world_created: Callable[[Plant, SimulatedWorld], None],
) -> GatekeeperTrialResult:
    """Propose `errand` at the door of a gatekeeper, break by `fault`, go on for `aftermath` [s] after the contract.

    `seen` may put an observer of truth into the world before it begins.
    """
    world = make_world(spec, robot_model, seed=seed)
    plant = world.plant
    on_world_created(plant, world)
    injector = FaultInjector(fault, lambda: plant.now)
    robot = LockstepRobot(robot=FaultyRobot(plant, injector, robot_model), world=world, plant=plant, injector=injector)
    found, outcomes = (
        GatekeeperTrialResult(plant=plant, world=world, injector=injector, trace=Trace(robot_model.n, robot_model.nq)),
        list[Outcome](),
    )
    registry = skill_registry(robot_model)
    with tempfile.TemporaryDirectory(prefix="dualbrain-") as name:
        keys, door = load_or_create_keys(Path(name) / "k"), SocketServer(Path(name) / "s")
        keeper = Gatekeeper(
            robot_model,
            robot,
            door,
            keys,
            {PLANNER: full_capability(registry)},
            settings=GatekeeperSettings(timing=SIMULATED),
            trace=found.trace,
            monotonic=lambda: plant.now,
            on_outcome=outcomes.append,
        )
        context = {"robot": robot_model.name, "registry": registry.hash}
        speed = "max_speed" if robot_model.is_mobile else "speed"
        texts = [
            msgspec.json.encode({"id": "c-0001", "context": context, "action_sequence": actions})
            for actions in (
                contract_actions,
                [{**contract_actions[0], "params": {**contract_actions[0]["params"], speed: FORBIDDEN_SPEED}}],
            )
        ]
        commander = FaultyCommander(door.path, keys, PLANNER, injector, *texts)
        over: list[float] = []

        def each(now: float) -> None:
            keeper.wait_for_gate_worker()
            commander.step(now)
            if outcomes and not over:
                over.append(now)
                commander.stop_proposing()
            if now > MAX_EPISODE_TIME or (over and now > over[0] + aftermath and not keeper.busy):
                keeper.shut_down()

        robot.on_period = each
        try:
            keeper.run()
        finally:
            commander.close()
            door.close()
        found.outcome = outcomes[0] if outcomes else found.outcome
        found.final_action = keeper.loop.safety_controller.decision.action.name
    return found
