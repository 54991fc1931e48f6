"""Four contracts knock at the gate: one is let in, the other three are stopped, each at another stage.

Run: `python examples/01_gate_a_contract.py`. Needs neither a planner, nor a simulator, nor weights.
"""

from __future__ import annotations

import json
from typing import Any

from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.verdict import Accepted, Rejected
from dualbrain.robots.loader import load_robot
from dualbrain.skills.registry import arm_skill_registry

REGISTRY = arm_skill_registry(load_robot("panda"))
NAMES = SceneNames(graspable=("red_cube", "teal_cup"), receptive=("blue_bowl",))

GRASP = {
    "object": "red_cube",
    "speed": 0.2,
    "clearance": 0.12,
    "finger_axis": "along",
    "opening": 0.07,
    "approach": "top",
    "wait": "none",
    "force": 20,
}
PLACE = {"destination": "blue_bowl", "speed": 0.2, "clearance": 0.12, "route": "direct", "wait": "none"}


def contract(*actions: tuple[str, dict[str, Any]]) -> dict[str, Any]:
    """A contract for this robot and this registry, as a planner would write it."""
    return {
        "id": "c-0001",
        "context": {"robot": REGISTRY.robot, "registry": REGISTRY.hash},
        "action_sequence": [{"skill": skill, "params": params} for skill, params in actions],
    }


CASES = {
    "grasp, then place": contract(("grasp", GRASP), ("place", PLACE)),
    "a parameter is missing": contract(("grasp", {k: v for k, v in GRASP.items() if k != "force"})),
    "a skill that nobody registered": contract(("throw", {"object": "red_cube"})),
    "much faster than the arm may go": contract(("grasp", GRASP | {"speed": 2.0})),
}


def main() -> None:
    """Check every case and print the verdict."""
    gate = Gate(REGISTRY, {"planner": frozenset(REGISTRY.by_name)})
    print(f"robot {REGISTRY.robot}, registry {REGISTRY.hash}, skills: {', '.join(REGISTRY.by_name)}\n")
    for title, written in CASES.items():
        verdict = gate.check(json.dumps(written).encode(), names=NAMES, principal="planner", now=0.0)
        match verdict:
            case Accepted(accepted):
                print(f"{title}: accepted, {' → '.join(action.skill for action in accepted.action_sequence)}")
            case Rejected(stage=stage, pointer=pointer, got=got, allowed=_, hint=hint):
                print(f"{title}: rejected at {stage}, {pointer}: got {got!r}; {hint}")


if __name__ == "__main__":
    main()
