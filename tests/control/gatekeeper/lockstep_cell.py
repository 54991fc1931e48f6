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
    """A running gatekeeper: its socket, the folder of its keys, and the keys themselves."""

    gatekeeper: Gatekeeper
    socket: Path
    keys_path: Path
    keys: Keys

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


@contextmanager
def lockstep_cell(folder, *, gate=None, recorder=None, trace=None):
    """A gatekeeper that runs in a thread until the context ends; `gate` replaces its gate."""
    robot_model, spec = load_robot("panda"), open_scene("bare:0")
    plant = Plant(spec, robot_model)
    world = SimulatedWorld(plant, NoisyPerception(spec, PerceptionNoise(), np.random.default_rng(0)))
    injector = FaultInjector(Fault("state", "off", "closing"), lambda: plant.now)
    keys_path = folder / "keys"
    keys, server = load_keys(keys_path, PRINCIPALS), SocketServer(folder / "s")
    capabilities = {"planner": full_capability(skill_registry(robot_model))}
    robot = LockstepRobot(
        robot=FaultyRobot(plant, injector, robot_model),
        world=world,
        plant=plant,
        injector=injector,
        on_period=lambda now: time.sleep(1e-3),
    )
    gatekeeper = Gatekeeper(
        robot_model,
        robot,
        server,
        gate or InlineGate(GateSetup(robot_model=robot_model, capabilities=capabilities)),
        keys,
        capabilities,
        settings=GatekeeperSettings(timing=SIMULATED),
        recorder=recorder,
        trace=trace,
    )
    thread = Thread(target=gatekeeper.run, name="gatekeeper")
    thread.start()
    try:
        yield LockstepCell(gatekeeper=gatekeeper, socket=server.path, keys_path=keys_path, keys=keys)
    finally:
        gatekeeper.shut_down()
        thread.join()
        server.close()
