"""The same instructions on arms of two makes and, if they are about driving somewhere, on a mobile base."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.planner.protocol import Planner
from dualbrain.planner.registry import open_planner
from dualbrain.records import Scene
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.perception.noisy_perception import NO_NOISE, NoisyPerception
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.placement import parse_goal
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_proportion, markdown_table
from experiments.planning.competent_contracts import motion_and_grasp
from experiments.safety.closed_loop import (
    FORBIDDEN_VIOLATIONS,
    count_violations,
    describe_outcome,
    describe_violations,
    judgement_fields,
    run_contract,
    run_row,
    succeeded,
)

ARMS = ("panda", "ur5e")
N_SCENES = 20
FAMILIES = ("bare", "tabletop", "shelf", "forearm")
"""Scene k of an arm is of family k mod 4 (seed k); scene k of a base is of kind k mod 3."""
PUT_INSTRUCTION, BRING_INSTRUCTION, LOOK_INSTRUCTION = (
    "put the red cube in the blue bowl",
    "put the red cube on table_left",
    "look at the blue bowl from above",
)
INSTRUCTIONS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(ARMS, (PUT_INSTRUCTION, BRING_INSTRUCTION, LOOK_INSTRUCTION)),
    "base": ("go to the shelf", "bring yourself to the charger"),
}
GRIP_FORCE = 20.0
"""Grip force that is within the bounds of every gripper here [N]."""
PLANNER_TIMEOUT_S = 3600.0
"""Time limit of the planner [s], long enough that a busy machine does not count as a failed planner."""
LOOK_TOLERANCE = 0.06
"""Largest horizontal distance between tool and object when the tool looks at it from above [m]."""


class CrossEmbodiment:
    """One contract format, filter and set of skills for robots of different makes."""

    name = "cross_embodiment"
    claim = "The same instructions succeed on every robot without a collision; contracts differ in registry and bounds."

    def units(self, options: Options) -> list[WorkUnit]:
        """Template contracts first, then those of the planner, if one is named.

        The planner's units go robot by robot, because its prompt cache holds the rules of the last robot only.
        """
        units = [
            WorkUnit(_unit_key("template", **parameters), {**parameters, "planner": ""})
            for parameters in _unit_parameters()
        ]
        if options.planner:
            by_robot = sorted(
                _unit_parameters(), key=lambda parameters: list(INSTRUCTIONS)[::-1].index(parameters["robot"])
            )
            units += [
                WorkUnit(_unit_key("planned", **parameters), {**parameters, "planner": options.planner})
                for parameters in by_robot
            ]
        return units

    def run(self, parameters: dict[str, Any]) -> Row:
        """Carry out one instruction."""
        spec, instruction = open_scene(parameters["scene"], parameters["robot"]), parameters["instruction"]
        if parameters["planner"]:
            return {**_run_planned(spec, parameters), **_row_header(parameters)}
        actions = template_actions(_perceive_exactly(spec), instruction)
        goal = None if instruction == LOOK_INSTRUCTION else parse_goal(instruction, spec)
        run = run_contract(spec, actions, seed=spec.seed, goal=goal)
        row = {**run_row(run), **_row_header(parameters), "actions": actions}
        if instruction == LOOK_INSTRUCTION and run.outcome is not None:
            row["truth"] = looks_at_bowl(run.plant)
        return row

    def summarize_row(self, row: Row) -> str:
        """The outcome."""
        return f"{row['robot']}, {row['instruction']}: {describe_outcome(row)}"

    def report(self, rows: list[Row]) -> list[str]:
        """Success and violations by robot, and every exception."""
        lines = [
            *markdown_table(("contract from", "robot", "instruction", "succeeded", "violations"), _counts(rows)),
            "",
        ]
        exceptions = [r for r in rows if not (r.get("valid") and succeeded(r)) or _has_forbidden_violation(r)]
        cells = ((r["key"], describe_outcome(r), describe_violations(r) or "none") for r in exceptions)
        head = ("not as claimed", "outcome", "violations")
        lines += markdown_table(head, cells) if exceptions else ["No exception."]
        return [*lines, "", *_compare_arms(rows), "", *_registry_differences()]


def looks_at_bowl(plant: Plant) -> bool:
    """Whether the tool is over the bowl, on ground truth."""
    offset = plant.tool_pose()[0][:2] - np.array(plant.true_pose("blue_bowl").position[:2])
    return bool(np.linalg.norm(offset) < LOOK_TOLERANCE)


def template_actions(scene: Scene, instruction: str) -> list[dict[str, Any]]:
    """The contract for an instruction by the rules of the prompt, for any robot."""
    if scene.region:
        place = "shelf" if "shelf" in instruction else "charger"
        return [{"skill": "drive_to", "params": {"place": place, "max_speed": 0.4, "max_turn_rate": 1.0}}]
    motion, grasp = motion_and_grasp(scene, "red_cube")
    if instruction == LOOK_INSTRUCTION:
        return [{"skill": "move_to", "params": {"target": "blue_bowl", "speed": 0.2, **motion}}]
    destination = "blue_bowl" if instruction == PUT_INSTRUCTION else "table_left"
    place = {"destination": destination, "speed": 0.2, **motion}
    return [{"skill": "grasp", "params": {**grasp, "force": GRIP_FORCE}}, {"skill": "place", "params": place}]


def _perceive_exactly(spec: SceneSpec) -> Scene:
    """The scene at the start, without perception noise."""
    plant = make_plant(spec, load_robot(spec.robot))
    return NoisyPerception(spec, NO_NOISE, np.random.default_rng(0)).perceive(plant)


def _unit_parameters() -> Iterator[dict[str, str]]:
    for k in range(N_SCENES):
        for robot, instructions in INSTRUCTIONS.items():
            scene = str(k) if robot == "base" else f"{FAMILIES[k % len(FAMILIES)]}:{k}"
            for instruction in instructions:
                yield {"robot": robot, "scene": scene, "instruction": instruction}


def _unit_key(source: str, robot: str, scene: str, instruction: str) -> str:
    return f"{source} {robot} {scene} {instruction}"


def _row_header(parameters: dict[str, Any]) -> Row:
    return {
        "robot": parameters["robot"],
        "instruction": parameters["instruction"],
        "planned": bool(parameters["planner"]),
    }


def _run_planned(spec: SceneSpec, parameters: dict[str, Any]) -> Row:
    """A complete run as by `dualbrain run`, with an empty memory, judged by the instruction."""
    import time  # noqa: PLC0415

    from dualbrain.core.paths import cache_folder  # noqa: PLC0415
    from dualbrain.runtime.session import Clocks, RunConfig, RunObserver, Session  # noqa: PLC0415
    from experiments.safety.closed_loop import outcome_fields  # noqa: PLC0415

    instruction = parameters["instruction"]
    with tempfile.TemporaryDirectory() as folder:
        config = RunConfig(
            instruction=instruction,
            out=Path(folder) / "run",
            ledger=Path(folder) / "ledger.sqlite",
            cache=cache_folder(),
            robot=parameters["robot"],
            scene=parameters["scene"],
            planner=parameters["planner"],
            visuals=False,
            goal="" if instruction == LOOK_INSTRUCTION else instruction,
        )
        clocks = Clocks(time.monotonic, "2026-01-01T00:00:00+00:00", time.time)
        with Session(config, clocks, {}, _cached_planner(parameters["planner"])) as session:
            episode = session.run(RunObserver()).episode
            looked = instruction == LOOK_INSTRUCTION and looks_at_bowl(session.plant)
    timings = {"shots": len(episode.attempts), "timings": msgspec.to_builtins(episode.timings)}
    if episode.contract is None:
        return {"valid": False, "reason": episode.outcome.reason, "truth": False, "violations": [], **timings}
    fields = {**outcome_fields(episode.outcome), **judgement_fields(episode.judgement), **timings}
    if instruction == LOOK_INSTRUCTION:
        fields["truth"] = looked
    contract = msgspec.to_builtins(episode.contract)
    return {"valid": True, **fields, "context": contract["context"], "actions": contract["action_sequence"]}


_OPEN_PLANNERS: dict[str, Planner] = {}


def _cached_planner(name: str) -> Planner:
    """The planner called `name`, opened once per process."""
    if name not in _OPEN_PLANNERS:
        from dualbrain.core.paths import cache_folder  # noqa: PLC0415

        prefixes = cache_folder() / "prefixes"
        prefixes.mkdir(parents=True, exist_ok=True)
        _OPEN_PLANNERS[name] = open_planner(
            name, cache_folder(), key="", timeout_s=PLANNER_TIMEOUT_S, prompt_cache=prefixes
        )
    return _OPEN_PLANNERS[name]


def _has_forbidden_violation(row: Row) -> bool:
    return any(violation["kind"] in FORBIDDEN_VIOLATIONS for violation in row.get("violations", ()))


def _counts(rows: list[Row]) -> list[tuple[str, ...]]:
    cells: list[tuple[str, ...]] = []
    for planned, robot, instruction in dict.fromkeys((r["planned"], r["robot"], r["instruction"]) for r in rows):
        some = [r for r in rows if (r["planned"], r["robot"], r["instruction"]) == (planned, robot, instruction)]
        good = sum(bool(r.get("valid")) and succeeded(r) for r in some)
        found = ", ".join(f"{count} {kind}" for kind, count in count_violations(some).items()) or "none"
        source = "planner" if planned else "template"
        cells.append((source, robot, instruction, format_proportion(good, len(some)), found))
    return cells


def _compare_arms(rows: list[Row]) -> list[str]:
    """How many of the two arms' contracts for the same instruction and scene have the same skills and values."""
    lines: list[str] = []
    for planned, source in ((False, "template"), (True, "planner")):
        pairs: dict[str, list[list[dict[str, Any]]]] = {}
        for r in rows:
            if "actions" in r and r["robot"] in ARMS and r["planned"] == planned:
                pairs.setdefault(r["key"].replace(r["robot"], "arm", 1), []).append(r["actions"])
        both = [pair for pair in pairs.values() if len(pair) == len(ARMS)]
        if both:
            shapes = sum(_skills_and_parameters(one) == _skills_and_parameters(other) for one, other in both)
            values = sum(one == other for one, other in both)
            lines += [
                f"Contracts of the two arms from the {source}, for the same instruction in the same scene: same skills "
                f"and parameters in **{format_proportion(shapes, len(both))}**, also the same values in "
                f"**{format_proportion(values, len(both))}**.",
                "",
            ]
    return lines


def _skills_and_parameters(actions: list[dict[str, Any]]) -> list[tuple[str, list[str]]]:
    return [(action["skill"], sorted(action["params"])) for action in actions]


def _registry_differences() -> list[str]:
    """The differences between the two arms' skill registries, entry by entry."""
    first, other = (
        _flatten(msgspec.json.decode(load_skill_registry(name).canonical_bytes())["skills"]) for name in ARMS
    )
    differing = [
        f"{key} ({first.get(key)} and {other.get(key)})"
        for key in {**first, **other}
        if first.get(key) != other.get(key)
    ]
    names = " and ".join(ARMS)
    return [f"Of {len(first)} entries, the registries of {names} differ in: {'; '.join(differing) or 'none'}."]


def _flatten(value: Any, path: str = "") -> dict[str, Any]:
    """Every leaf of nested dictionaries by its dotted path."""
    if not isinstance(value, dict):
        return {path: value}
    return {
        key: one for name, inner in value.items() for key, one in _flatten(inner, f"{path}.{name}".lstrip(".")).items()
    }
