"""A fault of planner or socket, injected in lockstep: the whole gatekeeper, its door and its gate around a plant."""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dualbrain.contracts.contract import Contract
from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.control.gatekeeper.capability import full
from dualbrain.control.gatekeeper.gatekeeper import Gatekeeper
from dualbrain.control.gatekeeper.protocol.authentication import open_keys
from dualbrain.control.gatekeeper.protocol.server import Door
from dualbrain.control.recording.trace import Trace
from dualbrain.evaluation.fault_injection.faults import Fault, FaultyRobot, Injector
from dualbrain.evaluation.fault_injection.faulty_client import FaultyCommander
from dualbrain.records import Outcome, Scene
from dualbrain.robots.interface import Command, RobotState
from dualbrain.robots.model import Body
from dualbrain.safety.supervisor.timing import SIMULATED
from dualbrain.simulation.perception.noisy_perception import Noise, Perception
from dualbrain.simulation.plant.factory import open_plant
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.world import SimulatedWorld
from dualbrain.skills.registry import registry_of

LONGEST = 60.0
"""[s] after which an episode is given up."""
FOLLY = 3.0
"""A speed [m/s] that no gate lets through."""


@dataclass
class LockstepRobot:
    """A plant at the gatekeeper's wire: `each(now)` is called after every period."""

    robot: FaultyRobot
    world: SimulatedWorld
    plant: Plant
    injector: Injector
    each: Callable[[float], None] = lambda now: None

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

    def look(self) -> Scene:
        """The scene as perceived now."""
        return self.world.look()

    def advance(self) -> None:
        """One control period."""
        self.world.advance()
        self.each(self.plant.now)

    def clock(self) -> float:
        """Simulated time [s]."""
        return self.plant.now

    def flags(self) -> int:
        """In lockstep nothing is late."""
        return 0

    def allow(self, phase: str, roles: dict[str, str | None]) -> None:
        """Tell monitor and injector."""
        self.world.allow(phase, roles)
        self.injector.phase(phase)

    def begin(self, contract: Contract) -> None:
        """Tell the referee."""
        self.world.begin(contract)


@dataclass
class Attended:
    """What one episode at the door led to."""

    plant: Plant
    world: SimulatedWorld
    injector: Injector
    trace: Trace
    outcome: Outcome = field(default_factory=lambda: Outcome("stopped", "it never began"))
    final: str = ""


def attend(
    fault: Fault, body: Body, spec: SceneSpec, errand: list[dict[str, Any]], seed: int, aftermath: float,
    seen: Callable[[Plant, SimulatedWorld], None],
) -> Attended:  # fmt: skip
    """Propose `errand` at the door of a gatekeeper, break by `fault`, go on for `aftermath` [s] after the contract.

    `seen` may put an observer of truth into the world before it begins.
    """
    plant = open_plant(spec, body)
    world = SimulatedWorld(plant, Perception(spec, Noise(), np.random.default_rng([seed, 1])))
    seen(plant, world)
    injector = Injector(fault, lambda: plant.now)
    robot = LockstepRobot(FaultyRobot(plant, injector, body), world, plant, injector)
    found, outcomes = Attended(plant, world, injector, Trace(body.n, body.width)), list[Outcome]()
    registry = registry_of(body)
    with tempfile.TemporaryDirectory(prefix="dualbrain-") as name:
        keys, door = open_keys(Path(name) / "k"), Door(Path(name) / "s")
        keeper = Gatekeeper(
            body, robot, door, keys, {PLANNER: full(registry)}, timing=SIMULATED, trace=found.trace,
            monotonic=lambda: plant.now, ended=outcomes.append,
        )  # fmt: skip
        context = {"robot": body.name, "registry": registry.hash}
        speed = "max_speed" if body.mobile else "speed"
        texts = [
            msgspec.json.encode({"id": "c-0001", "context": context, "action_sequence": actions})
            for actions in (errand, [{**errand[0], "params": {**errand[0]["params"], speed: FOLLY}}])
        ]
        commander = FaultyCommander(door.path, keys, PLANNER, injector, *texts)
        over: list[float] = []

        def each(now: float) -> None:
            keeper.settle()
            commander.step(now)
            if outcomes and not over:
                over.append(now)
                commander.hush()
            if now > LONGEST or (over and now > over[0] + aftermath and not keeper.busy):
                keeper.shut_down()

        robot.each = each
        try:
            keeper.run()
        finally:
            commander.close()
            door.close()
        found.outcome = outcomes[0] if outcomes else found.outcome
        found.final = keeper.layer.spine.order.action.name
    return found
