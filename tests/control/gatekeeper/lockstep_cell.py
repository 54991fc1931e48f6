"""A gatekeeper in a thread, in lockstep with a simulated robot, for tests of its socket."""

import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from threading import Thread

import numpy as np

from dualbrain.control.gatekeeper.capability import full_capability
from dualbrain.control.gatekeeper.gate.exchange import GateSetup
from dualbrain.control.gatekeeper.gate.inline_gate import InlineGate
from dualbrain.control.gatekeeper.gatekeeper import Gatekeeper, GatekeeperSettings
from dualbrain.control.gatekeeper.protocol.authentication import PRINCIPALS, Keys, load_keys
from dualbrain.control.gatekeeper.protocol.server import SocketServer
from dualbrain.evaluation.fault_injection.faults import Fault, FaultInjector, FaultyRobot
from dualbrain.evaluation.fault_injection.gatekeeper_trial import LockstepRobot
from dualbrain.robots.loader import load_robot
from dualbrain.safety.supervisor.timing import SIMULATED
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.world import SimulatedWorld
from dualbrain.skills.registry import skill_registry

TIMEOUT = 60.0
"""Longest wait for a condition [s]."""


@dataclass(kw_only=True)
class LockstepCell:
    """A gatekeeper: its server, the plant that it controls, the folder of its keys, and the keys themselves."""

    gatekeeper: Gatekeeper
    server: SocketServer
    plant: Plant
    keys_path: Path
    keys: Keys

    @property
    def socket(self) -> Path:
        """The path of its socket."""
        return self.server.path

    @property
    def action(self) -> str:
        """The supervisor's action in the newest tick."""
        return self.gatekeeper.loop.safety_controller.decision.action.name

    def wait_for_action(self, action: str) -> None:
        """Wait until the supervisor's action is `action`."""
        deadline = time.monotonic() + TIMEOUT
        while self.action != action:
            assert time.monotonic() < deadline, f"the action is {self.action}, not {action}"
            time.sleep(0.005)


def make_cell(
    folder,
    scene="bare:0",
    *,
    gate=None,
    on_period=lambda now: None,
    robot_time=False,
    settings=None,
    **options,
):
    """A gatekeeper that does not run yet.

    `on_period(now)` is called after every period of the robot, `gate` replaces the gate, `robot_time` times connections
    by the robot's clock, `settings` replaces those of a simulated robot, and `options` are further arguments of the
    gatekeeper.
    """
    robot_model, spec = load_robot("panda"), open_scene(scene)
    plant = Plant(spec, robot_model)
    world = SimulatedWorld(plant, NoisyPerception(spec, PerceptionNoise(), np.random.default_rng(0)))
    no_fault, phases = (FaultInjector(Fault("state", "off", "closing"), lambda: plant.now) for _ in range(2))
    keys_path = folder / "keys"
    keys, server = load_keys(keys_path, PRINCIPALS), SocketServer(folder / "s")
    capabilities = {"planner": full_capability(skill_registry(robot_model))}
    robot = LockstepRobot(
        robot=FaultyRobot(plant, no_fault, robot_model),
        world=world,
        plant=plant,
        injector=phases,  # only this one learns the phases, so that no fault begins
        on_period=on_period,
    )
    gatekeeper = Gatekeeper(
        robot_model,
        robot,
        server,
        gate or InlineGate(GateSetup(robot_model=robot_model, capabilities=capabilities)),
        keys,
        capabilities,
        settings=settings or GatekeeperSettings(timing=SIMULATED),
        monotonic=(lambda: plant.now) if robot_time else time.monotonic,
        **options,
    )
    return LockstepCell(gatekeeper=gatekeeper, server=server, plant=plant, keys_path=keys_path, keys=keys)


@contextmanager
def lockstep_cell(folder, **options):
    """A gatekeeper that runs in a thread until the context ends; `options` are those of `make_cell`."""
    cell = make_cell(folder, on_period=lambda now: time.sleep(1e-3), **options)
    thread = Thread(target=cell.gatekeeper.run, name="gatekeeper")
    thread.start()
    try:
        yield cell
    finally:
        cell.gatekeeper.shut_down()
        thread.join()
        cell.server.close()
