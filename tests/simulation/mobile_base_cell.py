"""A base in a room with its local layer, without planner and memory."""

import numpy as np

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.contract_executor import LocalLayer
from dualbrain.control.control_loop import LayerConfig
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.robots.loader import load_body
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.perception.noisy_perception import Noise, Perception
from dualbrain.simulation.plant.factory import open_plant
from dualbrain.simulation.scenes.generators.rooms import make_room
from dualbrain.simulation.world import SimulatedWorld

BASE = load_body("base")


class Hall:
    def __init__(self, family="empty_room", seed=0, spec=None, standing=()):
        self.spec = spec or make_room(family, seed, "base")
        self.plant = open_plant(self.spec, BASE)
        self.trace = Trace(BASE.n, BASE.width)
        self.world = SimulatedWorld(self.plant, Perception(self.spec, Noise(), np.random.default_rng(seed)))
        self.monitor = self.world.monitor
        self.layer = LocalLayer(
            BASE, self.plant, self.world, SafetyFilter(BASE, standing=standing), FlightLog(self.trace),
            LayerConfig(settle=0.1), phase_changed=self.world.allow,
        )  # fmt: skip

    def run(self, *actions):
        contract = Contract("c-1", Context("base", ""), tuple(Action(skill, params) for skill, params in actions))
        self.world.begin(contract)
        return self.layer.run(contract)


def drive_to(place, max_speed=0.6):
    return ("drive_to", {"place": place, "max_speed": max_speed, "max_turn_rate": 1.2})
