"""The gate checks four contracts: it accepts one, and each of its three stages rejects one.

Run: `python examples/01_gate_a_contract.py`. Needs no planner, no simulator and no model files.
"""

from __future__ import annotations

import json
from typing import Any

from dualbrain import Accepted, Gate, Rejected, SceneNames, load_robot, skill_registry

REGISTRY = skill_registry(load_robot("panda"))
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
    """A contract for this robot and this registry, as a planner writes it."""
    return {
        "id": "c-0001",
        "context": {"robot": REGISTRY.robot, "registry": REGISTRY.hash},
        "action_sequence": [{"skill": skill, "params": params} for skill, params in actions],
    }


CASES = {
    "grasp, then place": contract(("grasp", GRASP), ("place", PLACE)),
    "a parameter is missing": contract(("grasp", {k: v for k, v in GRASP.items() if k != "force"})),
    "the skill is not registered": contract(("throw", {"object": "red_cube"})),
    "the speed is beyond its bound": contract(("grasp", GRASP | {"speed": 2.0})),
}


def main() -> None:
    """Check every contract and print the verdict."""
    gate = Gate(REGISTRY, {"planner": frozenset(REGISTRY.by_name)})
    print(f"robot {REGISTRY.robot}, registry {REGISTRY.hash}, skills: {', '.join(REGISTRY.by_name)}\n")
    for title, proposal in CASES.items():
        verdict = gate.check(json.dumps(proposal).encode(), names=NAMES, principal="planner", now=0.0)
        match verdict:
            case Accepted(accepted):
                print(f"{title}: accepted, {' → '.join(action.skill for action in accepted.action_sequence)}")
            case Rejected(stage=stage, pointer=pointer, got=got, allowed=_, hint=hint):
                print(f"{title}: rejected at {stage}, {pointer}: got {got!r}; {hint}")


if __name__ == "__main__":
    main()
