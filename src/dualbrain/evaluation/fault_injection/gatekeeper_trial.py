"""Trial of a planner or socket fault in lockstep, with the whole gatekeeper, its server and its gate around a plant."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

import msgspec
from numpy.typing import NDArray

from dualbrain.contracts.contract import Contract
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.control.gatekeeper.capability import full_capability
from dualbrain.control.gatekeeper.gate.exchange import GateSetup
from dualbrain.control.gatekeeper.gate.inline_gate import InlineGate
from dualbrain.control.gatekeeper.gatekeeper import Gatekeeper, GatekeeperSettings
from dualbrain.control.gatekeeper.protocol.authentication import PRINCIPALS, load_keys
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
"""Simulated time [s] after which an episode is ended."""
FORBIDDEN_SPEED = 3.0
"""A speed [m/s] that every gate rejects."""


class MotionObserver(Protocol):
    """Observes the true motion of a trial."""

    def observe(self, plant: Plant) -> None:
        """Receive the plant, before its first period."""
        ...

    def __call__(self, now: float) -> None:
        """Observe the true state at `now` [s], the end of a period."""
        ...


@dataclass(kw_only=True)
class LockstepRobot:
    """A plant behind the gatekeeper's robot link, in lockstep; `on_period(now)` is called after every period."""

    robot: FaultyRobot
    world: SimulatedWorld
    plant: Plant
    injector: FaultInjector
    on_period: Callable[[float], None] = lambda now: None

    def read(self) -> RobotState:
        """The newest joint state."""
        return self.robot.read()

    def write(self, command: Command) -> None:
        """Apply `command` until the next one."""
        self.robot.write(command)

    def stop(self) -> None:
        """Switch the drive off."""
        self.robot.stop()

    def enable(self) -> None:
        """Switch the drive on."""
        self.robot.enable()

    def perceive(self) -> Scene:
        """The scene as perceived now."""
        return self.world.perceive()

    def advance(self) -> None:
        """Simulate one control period."""
        self.world.advance()
        self.on_period(self.plant.now)

    def skip_to_newest_state(self) -> None:
        """There is one state, the present one."""

    def clock(self) -> float:
        """Simulated time [s]."""
        return self.plant.now

    def conditions(self) -> int:
        """No timing conditions, because nothing is late in lockstep."""
        return 0

    def notes(self) -> list[str]:
        """No texts in lockstep."""
        return []

    def thread_ticks(self) -> NDArray[Any] | None:
        """None: no thread moves the joints."""
        return None

    def timing_faults(self) -> tuple[int, int]:
        """No faults, because nothing is late in lockstep."""
        return 0, 0

    def set_phase(self, phase: str, roles: dict[str, str | None]) -> None:
        """Report the phase to the monitor and the injector."""
        self.world.set_phase(phase, roles)
        self.injector.set_phase(phase)

    def start_contract(self, contract: Contract) -> None:
        """Report the contract to the judge."""
        self.world.start_contract(contract)


@dataclass(kw_only=True)
class GatekeeperTrialResult:
    """Result of one episode through a gatekeeper."""

    plant: Plant
    world: SimulatedWorld
    injector: FaultInjector
    trace: Trace
    outcome: Outcome = field(default_factory=lambda: Outcome(kind="stopped", reason="it never started"))
    final_action: str = ""


def run_gatekeeper_trial(
    fault: Fault,
    robot_model: RobotModel,
    spec: SceneSpec,
    contract_actions: list[dict[str, Any]],
    seed: int,
    aftermath: float,
    observer: MotionObserver,
) -> GatekeeperTrialResult:
    """Propose a contract to a gatekeeper, inject `fault`, and continue for `aftermath` [s] after the contract.

    `observer` receives the plant, and after every period the simulated time.
    """
    world = make_world(spec, robot_model, seed=seed, pace=observer)
    plant = world.plant
    observer.observe(plant)
    injector = FaultInjector(fault, lambda: plant.now)
    robot = LockstepRobot(robot=FaultyRobot(plant, injector, robot_model), world=world, plant=plant, injector=injector)
    trace = Trace(robot_model.n, robot_model.nq)
    result = GatekeeperTrialResult(plant=plant, world=world, injector=injector, trace=trace)
    outcomes: list[Outcome] = []
    registry = skill_registry(robot_model)
    capabilities = {PLANNER: full_capability(registry)}
    with tempfile.TemporaryDirectory(prefix="dualbrain-") as name:
        keys, server = load_keys(Path(name) / "k", PRINCIPALS), SocketServer(Path(name) / "s")
        gatekeeper = Gatekeeper(
            robot_model,
            robot,
            server,
            InlineGate(GateSetup(robot_model=robot_model, capabilities=capabilities)),
            keys,
            capabilities,
            settings=GatekeeperSettings(timing=SIMULATED),
            trace=trace,
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
        commander = FaultyCommander(server.path, keys, PLANNER, injector, *texts)
        ended_at: list[float] = []

        def on_period(now: float) -> None:
            commander.step(now)
            if outcomes and not ended_at:
                ended_at.append(now)
                commander.stop_proposing()
            if now > MAX_EPISODE_TIME or (ended_at and now > ended_at[0] + aftermath and not gatekeeper.busy):
                gatekeeper.shut_down()

        robot.on_period = on_period
        try:
            gatekeeper.run()
        finally:
            commander.close()
            server.close()
        result.outcome = outcomes[0] if outcomes else result.outcome
        result.final_action = gatekeeper.loop.safety_controller.decision.action.name
    return result
