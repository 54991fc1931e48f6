"""A given contract becomes motion in simulation: gate, skills, filter, plant; no planner, no memory, no weights.

Run: `python examples/03_run_a_contract.py`. Needs MuJoCo (`pip install 'dualbrain[world]'`).
"""

from __future__ import annotations

import json

import numpy as np

from dualbrain.contracts.gate.authorization import PLANNER
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.verdict import Accepted
from dualbrain.control.contract_executor import ContractExecutor
from dualbrain.control.control_loop import ExecutorConfig
from dualbrain.control.recording.flight_log import FlightLog
from dualbrain.control.recording.trace import Trace
from dualbrain.grounding.scene_rules import scene_rules
from dualbrain.grounding.vocabulary import load_skill_registry, planner_grants, scene_names
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.simulation.perception.noisy_perception import NoisyPerception, PerceptionNoise
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.world import SimulatedWorld

GRASP = {
    "object": "red_cube",
    "speed": 0.3,
    "clearance": 0.10,
    "finger_axis": "along",
    "opening": 0.07,
    "approach": "top",
    "wait": "none",
    "force": 20,
}
PLACE = {"destination": "blue_bowl", "speed": 0.3, "clearance": 0.10, "route": "direct", "wait": "none"}


def main() -> None:
    """Put the red cube into the bowl of the bare scene and print what happened."""
    robot_model, registry, spec = load_robot("panda"), load_skill_registry("panda"), make_scene("bare", 1)
    plant = Plant(spec, robot_model)
    world = SimulatedWorld(plant, NoisyPerception(spec, PerceptionNoise(), np.random.default_rng(0)))
    log = FlightLog(Trace(robot_model.n), on_event=lambda event: print(f"{event.t:6.2f} s  {event.text}"))
    layer = ContractExecutor(
        robot_model, plant, world, SafetyFilter(robot_model), log, ExecutorConfig(), on_phase=world.set_phase
    )

    written = {
        "id": "c-0001",
        "context": {"robot": registry.robot, "registry": registry.hash},
        "action_sequence": [{"skill": "grasp", "params": GRASP}, {"skill": "place", "params": PLACE}],
    }
    gate = Gate(registry, planner_grants(registry), scene_rules(layer.scene, layer.controller))
    verdict = gate.check(
        json.dumps(written).encode(), names=scene_names(layer.scene), principal=PLANNER, now=layer.state.stamp
    )
    if not isinstance(verdict, Accepted):
        print(f"rejected at {verdict.stage}: {verdict.hint}")
        return
    world.start_contract(verdict.contract)
    outcome, truth = layer.execute(verdict.contract), world.judgement()
    print(f"\n{outcome.kind}: {outcome.reason}")
    print(
        f"Δ {outcome.Delta:.4f}, intervened on {outcome.intervention_frequency:.1%} of ticks, "
        f"closest {outcome.h_min * 1000:.1f} mm beyond all margins, {outcome.duration:.1f} s of motion"
    )
    print(f"simulator truth: {'success' if truth.success else 'no success'}, {len(truth.violations)} violations")


if __name__ == "__main__":
    main()
