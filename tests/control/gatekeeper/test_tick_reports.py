"""Who watches a gatekeeper sees its arm move: pictures come as often as people can use them."""

from concurrent.futures import ThreadPoolExecutor

import numpy as np

from dualbrain.control.gatekeeper.capability import full
from dualbrain.control.gatekeeper.gatekeeper import Gatekeeper
from dualbrain.control.gatekeeper.protocol.authentication import open_keys
from dualbrain.control.gatekeeper.protocol.client import GatekeeperLink
from dualbrain.control.gatekeeper.protocol.messages import Glimpse
from dualbrain.control.gatekeeper.protocol.server import Door
from dualbrain.evaluation.fault_injection.faults import Fault, FaultyRobot, Injector
from dualbrain.evaluation.fault_injection.gatekeeper_trial import LockstepRobot
from dualbrain.robots.loader import load_body
from dualbrain.safety.supervisor.timing import SIMULATED
from dualbrain.simulation.perception.noisy_perception import Noise, Perception
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.world import SimulatedWorld
from dualbrain.skills.registry import registry_of

SECONDS = 2.0


def test_glimpses_come_some_fifteen_times_a_second_of_the_robots_time(tmp_path):
    body, spec = load_body("panda"), open_scene("bare:0")
    plant = Plant(spec, body)
    world = SimulatedWorld(plant, Perception(spec, Noise(), np.random.default_rng(0)))
    injector = Injector(Fault("state", "off", "closing"), lambda: plant.now)
    keys, door, seen = open_keys(tmp_path / "keys"), Door(tmp_path / "s"), []
    with ThreadPoolExecutor() as aside:
        watcher = aside.submit(GatekeeperLink, door.path, watch=seen.append)
        came = []

        def each(now):
            if watcher.done():
                came.append(now)
            if came and now > came[0] + SECONDS:
                keeper.shut_down()

        robot = LockstepRobot(FaultyRobot(plant, injector, body), world, plant, injector, each)
        keeper = Gatekeeper(body, robot, door, keys, {"planner": full(registry_of(body))}, timing=SIMULATED)
        keeper.run()
        door.close()
        assert watcher.result().lost.wait(20.0)
        watcher.result().close()
    stamps = [one.t for one in seen if isinstance(one, Glimpse)]
    assert 10.0 * SECONDS < len(stamps) < 20.0 * SECONDS
    assert stamps == sorted(set(stamps))
