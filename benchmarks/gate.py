"""Time of the gate, compared with pure-Python `jsonschema` on the same published schema and document.

    python -m benchmarks.gate [--json] [--rounds N]

The gate parses the bytes strictly, checks the grants and the header, and builds the contract; `jsonschema` only
validates the parsed document. Both alternate in one process, so that other load affects both. Times are medians over
all rounds.
"""

import argparse
import json
import platform
import statistics
import time
from collections.abc import Callable

from dualbrain.contracts.contract import ContractHeader
from dualbrain.contracts.gate.gate import Gate
from dualbrain.contracts.registry import SkillRegistry
from dualbrain.contracts.scene_names import SceneNames
from dualbrain.contracts.schema import validation_schema
from dualbrain.contracts.skill_spec import ChoiceParameter, NameParameter, NumberParameter, SkillSpec, TextParameter
from dualbrain.contracts.verdict import Accepted

SCENE_NAMES = SceneNames(("red_cube", "blue_cube", "cup"), ("bowl", "tray", "shelf_left"))
SKILL_COUNT, STEP_COUNT = 20, 8
TARGET_RATIO = 30.0


def build_registry() -> SkillRegistry:
    """Return twenty skills: 18 motions with four to six parameters, one with free text, one without parameters."""
    speed = NumberParameter(
        name="speed", unit="m/s", lower=0.05, upper=0.4, lower_from="site policy", upper_from="site policy"
    )
    clearance = NumberParameter(
        name="clearance", unit="m", lower=0.03, upper=0.35, lower_from="site policy", upper_from="reach of the arm"
    )
    force = NumberParameter(
        name="force", unit="N", lower=1.0, upper=70.0, lower_from="gripper data sheet", upper_from="gripper data sheet"
    )
    approach, route = (
        ChoiceParameter("approach", ("top", "side", "tilted")),
        ChoiceParameter("route", ("direct", "left", "right")),
    )
    objects = NameParameter("object", "graspable"), NameParameter("object", "receptive"), NameParameter("object", "any")
    motions = tuple(
        SkillSpec(f"motion_{i:02d}", "", (objects[i % 3], speed, clearance, approach, *((force, route)[: i % 3])))
        for i in range(SKILL_COUNT - 2)
    )
    return SkillRegistry(
        "panda", (*motions, SkillSpec("decline", "", (TextParameter("reason", 160),)), SkillSpec("home", ""))
    )


def build_document(registry: SkillRegistry) -> dict[str, object]:
    """Return a contract of eight actions with the last motions of the registry."""
    values = {"speed": 0.2, "clearance": 0.12, "approach": "top", "force": 25, "route": "left"}
    names = {"graspable": "red_cube", "receptive": "bowl", "any": "cup"}
    steps = [
        {
            "skill": skill.name,
            "params": {
                p.name: names[p.of] if isinstance(p, NameParameter) else values[p.name] for p in skill.parameters
            },
        }
        for skill in registry.skills[SKILL_COUNT - 2 - STEP_COUNT : SKILL_COUNT - 2]
    ]
    context = {"robot": registry.robot, "registry": registry.hash}
    return {"id": "c-0001", "context": context, "action_sequence": steps}


def microseconds(function: Callable[[], object], repeats: int) -> float:
    """Return the mean time of a call over `repeats` calls [µs]."""
    start = time.perf_counter()
    for _ in range(repeats):
        function()
    return (time.perf_counter() - start) / repeats * 1e6


def measure(rounds: int) -> dict[str, object]:
    """Return the medians of gate and `jsonschema` over `rounds` alternating rounds, and their ratio."""
    import jsonschema  # noqa: PLC0415

    registry = build_registry()
    document = build_document(registry)
    data = json.dumps(document, separators=(",", ":")).encode()
    gate = Gate(registry, {"planner": frozenset(registry.by_name)})
    peer = jsonschema.Draft7Validator(validation_schema(registry, SCENE_NAMES))
    numbers = iter(range(1, 10**9))

    def run_gate() -> object:
        header = ContractHeader(sequence=next(numbers), issued=0.0, expires=5.0, principal="planner", scene_version=1)
        return gate.check(data, names=SCENE_NAMES, principal="planner", now=1.0, header=header)

    def run_peer() -> object:
        return peer.is_valid(document)

    if not (isinstance(run_gate(), Accepted) and run_peer()):
        raise SystemExit("The gate or jsonschema rejects the document of the benchmark.")
    pairs = [(microseconds(run_gate, 50), microseconds(run_peer, 3)) for _ in range(rounds)]
    gate_us, peer_us = (statistics.median(column) for column in zip(*pairs, strict=True))
    return {
        "benchmark": "gate",
        "skills": SKILL_COUNT,
        "steps": STEP_COUNT,
        "bytes": len(data),
        "gate_us": round(gate_us, 2),
        "jsonschema_us": round(peer_us, 1),
        "ratio": round(statistics.median(b / a for a, b in pairs), 1),
        "target_ratio": TARGET_RATIO,
        "rounds": rounds,
        "python": platform.python_version(),
        "machine": platform.machine(),
    }


def main() -> None:
    """Print a table, or one JSON object with `--json`."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.add_argument("--rounds", type=int, default=200, help="alternating rounds (default 200)")
    options = parser.parse_args()
    result = measure(options.rounds)
    if options.json:
        print(json.dumps(result))
        return
    print(f"{result['skills']} skills, {result['steps']} steps, {result['bytes']} bytes, {result['rounds']} rounds")
    print(f"{'gate, from bytes':36}{result['gate_us']:>10} µs")
    print(f"{'jsonschema (pure Python)':36}{result['jsonschema_us']:>10} µs")
    print(f"{'ratio (target ≥ 30)':36}{result['ratio']:>10} ×")


if __name__ == "__main__":
    main()
