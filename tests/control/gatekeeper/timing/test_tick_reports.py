"""Tick reports: an observer of a gatekeeper gets them at the rate that people can use."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from dualbrain.control.gatekeeper.capability import full_capability
from dualbrain.control.gatekeeper.gate.exchange import GateSetup
from dualbrain.control.gatekeeper.gate.inline_gate import InlineGate
from dualbrain.control.gatekeeper.gatekeeper import Gatekeeper, GatekeeperSettings
from dualbrain.control.gatekeeper.protocol.authentication import PRINCIPALS, load_keys
from dualbrain.control.gatekeeper.protocol.client import GatekeeperClient
from dualbrain.control.gatekeeper.protocol.messages import TickReport
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

SECONDS = 2.0


def test_tick_reports_arrive_about_fifteen_times_per_second_of_the_robots_time(tmp_path):
    robot_model, spec = load_robot("panda"), open_scene("bare:0")
    plant = Plant(spec, robot_model)
    world = SimulatedWorld(plant, NoisyPerception(spec, PerceptionNoise(), np.random.default_rng(0)))
    injector = FaultInjector(Fault("state", "off", "closing"), lambda: plant.now)
    keys, server, reports = load_keys(tmp_path / "keys", PRINCIPALS), SocketServer(tmp_path / "s"), []
    capabilities = {"planner": full_capability(skill_registry(robot_model))}
    with ThreadPoolExecutor() as background:
        observer = background.submit(GatekeeperClient, server.path, on_report=reports.append)
        connected_at = []

        def on_period(now):
            if observer.done():
                connected_at.append(now)
            if connected_at and now > connected_at[0] + SECONDS:
                gatekeeper.shut_down()

        robot = LockstepRobot(
            robot=FaultyRobot(plant, injector, robot_model),
            world=world,
            plant=plant,
            injector=injector,
            on_period=on_period,
        )
        gatekeeper = Gatekeeper(
            robot_model,
            robot,
            server,
            InlineGate(GateSetup(robot_model=robot_model, capabilities=capabilities)),
            keys,
            capabilities,
            settings=GatekeeperSettings(timing=SIMULATED),
        )
        gatekeeper.run()
        server.close()
        assert observer.result().disconnected.wait(20.0)
        observer.result().close()
    stamps = [report.t for report in reports if isinstance(report, TickReport)]
    assert 10.0 * SECONDS < len(stamps) < 20.0 * SECONDS
    assert stamps == sorted(set(stamps))
