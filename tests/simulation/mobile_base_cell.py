"""A simulated mobile base with contract executor and safety filter, without planner and memory."""

import numpy as np

from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ControlLoop, ControlLoopConfig, LoopObserver
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.scenes.generators.rooms import make_room
from dualbrain.simulation.world import SimulatedWorld

MOBILE_BASE = load_robot("base")


class MobileBaseCell:
    def __init__(self, family="empty_room", seed=0, spec=None, fixed_obstacles=()):
        self.spec = spec or make_room(family, seed, "base")
        self.plant = make_plant(self.spec, MOBILE_BASE)
        self.trace = Trace(MOBILE_BASE.n, MOBILE_BASE.nq)
        self.world = SimulatedWorld(
            self.plant, NoisyPerception(self.spec, PerceptionNoise(), np.random.default_rng(seed))
        )
        self.monitor = self.world.monitor
        self.executor = ContractExecutor(
            ControlLoop(
                MOBILE_BASE,
                self.plant,
                self.world,
                SafetyFilter(MOBILE_BASE, obstacles=fixed_obstacles),
                FlightLog(self.trace),
                ControlLoopConfig(settle_time=0.1),
                LoopObserver(on_phase=self.world.set_phase),
            )
        )

    def run(self, *actions):
        contract = Contract("c-1", Context("base", ""), tuple(Action(skill, params) for skill, params in actions))
        self.world.start_contract(contract)
        return self.executor.execute(contract)


def drive_to_action(place, max_speed=0.6):
    return ("drive_to", {"place": place, "max_speed": max_speed, "max_turn_rate": 1.2})
