"""robots: the same instructions on arms of two makes and, where they are about going somewhere, on a base."""

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
"""Scene k of an arm is of family k mod 4 (seed k); that of a base of kind k mod 3."""
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
"""Grip force that every gripper here has [N]."""
PLANNER_TIMEOUT_S = 3600.0
"""With the planner, so that a busy machine is not taken for a planner that cannot [s]."""
LOOK_TOLERANCE = 0.06
"""The tool looks at a thing from above when it is within this of it in the plane [m]."""


class CrossEmbodiment:
    """One contract space, filter and set of skills for bodies of different makes."""

    name = "cross_embodiment"
    claim = "The same instructions succeed on every body without a collision; contracts differ in registry and bounds."

    def units(self, options: Options) -> list[WorkUnit]:
        """Template contracts first; then the same with the planner's own, where one is named.

        The planner's go robot by robot, because it reads each robot's rules once and keeps only the last it read.
        """
        units = [WorkUnit(_unit_key("template", **about), {**about, "planner": ""}) for about in _unit_parameters()]
        if options.planner:
            by_robot = sorted(_unit_parameters(), key=lambda about: list(INSTRUCTIONS)[::-1].index(about["robot"]))
            units += [
                WorkUnit(_unit_key("planned", **about), {**about, "planner": options.planner}) for about in by_robot
            ]
        return units

    def run(self, about: dict[str, Any]) -> Row:
        """Carry out one instruction."""
        spec, words = open_scene(about["scene"], about["robot"]), about["instruction"]
        if about["planner"]:
            return {**_run_planned(spec, about), **_row_header(about)}
        actions = template_actions(_perceive_exactly(spec), words)
        flight = run_contract(
            spec, actions, seed=spec.seed, goal=None if words == LOOK_INSTRUCTION else parse_goal(words, spec)
        )
        figures = {**run_row(flight), **_row_header(about), "actions": actions}
        if words == LOOK_INSTRUCTION and flight.outcome is not None:
            figures["truth"] = looks_at_bowl(flight.plant)
        return figures

    def summarize_row(self, row: Row) -> str:
        """How it ended."""
        return f"{row['robot']}, {row['instruction']}: {describe_outcome(row)}"

    def report(self, rows: list[Row]) -> list[str]:
        """Success and violations by body, and every exception."""
        lines = [
            *markdown_table(("contract from", "robot", "instruction", "succeeded", "violations"), _counts(rows)),
            "",
        ]
        bad = [r for r in rows if not (r.get("valid") and succeeded(r)) or _has_forbidden_violation(r)]
        cells = ((r["key"], describe_outcome(r), describe_violations(r) or "none") for r in bad)
        lines += markdown_table(("not as claimed", "outcome", "violations"), cells) if bad else ["No exception."]
        return [*lines, "", *_compare_arms(rows), "", *_registry_differences()]


def looks_at_bowl(plant: Plant) -> bool:
    """Whether the tool is over the bowl, on truth."""
    away = plant.tool_pose()[0][:2] - np.array(plant.true_pose("blue_bowl").position[:2])
    return bool(np.linalg.norm(away) < LOOK_TOLERANCE)


def template_actions(scene: Scene, words: str) -> list[dict[str, Any]]:
    """The contract that the prompt's rules make of an instruction, whatever the arm."""
    if scene.region:
        place = "shelf" if "shelf" in words else "charger"
        return [{"skill": "drive_to", "params": {"place": place, "max_speed": 0.4, "max_turn_rate": 1.0}}]
    way, grasp = motion_and_grasp(scene, "red_cube")
    if words == LOOK_INSTRUCTION:
        return [{"skill": "move_to", "params": {"target": "blue_bowl", "speed": 0.2, **way}}]
    destination = "blue_bowl" if words == PUT_INSTRUCTION else "table_left"
    place = {"destination": destination, "speed": 0.2, **way}
    return [{"skill": "grasp", "params": {**grasp, "force": GRIP_FORCE}}, {"skill": "place", "params": place}]


def _perceive_exactly(spec: SceneSpec) -> Scene:
    """The scene as it is at the start, exactly."""
    plant = make_plant(spec, load_robot(spec.robot))
    return NoisyPerception(spec, NO_NOISE, np.random.default_rng(0)).perceive(plant)


def _unit_parameters() -> Iterator[dict[str, str]]:
    for k in range(N_SCENES):
        for robot, instructions in INSTRUCTIONS.items():
            scene = str(k) if robot == "base" else f"{FAMILIES[k % len(FAMILIES)]}:{k}"
            for instruction in instructions:
                yield {"robot": robot, "scene": scene, "instruction": instruction}


def _unit_key(how: str, robot: str, scene: str, instruction: str) -> str:
    return f"{how} {robot} {scene} {instruction}"


def _row_header(about: dict[str, Any]) -> Row:
    return {"robot": about["robot"], "instruction": about["instruction"], "planned": bool(about["planner"])}


def _run_planned(spec: SceneSpec, about: dict[str, Any]) -> Row:
    """The whole loop as `dualbrain run` has it, with a memory of its own that is empty; judged by the instruction."""
    import time  # noqa: PLC0415

    from dualbrain.cli.common.paths import cache_folder  # noqa: PLC0415
    from dualbrain.runtime.session import Clocks, RunConfig, RunObserver, Session  # noqa: PLC0415
    from experiments.safety.closed_loop import outcome_fields  # noqa: PLC0415

    words = about["instruction"]
    with tempfile.TemporaryDirectory() as folder:
        config = RunConfig(
            instruction=words,
            out=Path(folder) / "run",
            ledger=Path(folder) / "ledger.sqlite",
            cache=cache_folder(),
            robot=about["robot"],
            scene=about["scene"],
            planner=about["planner"],
            visuals=False,
            goal="" if words == LOOK_INSTRUCTION else words,
        )
        times = Clocks(time.monotonic, "2026-01-01T00:00:00+00:00", time.time)
        with Session(config, times, {}, _cached_planner(about["planner"])) as session:
            episode = session.run(RunObserver()).episode
            looked = words == LOOK_INSTRUCTION and looks_at_bowl(session.plant)
    timings = {"shots": len(episode.attempts), "timings": msgspec.to_builtins(episode.timings)}
    if episode.contract is None:
        return {"valid": False, "reason": episode.outcome.reason, "truth": False, "violations": [], **timings}
    figures = {**outcome_fields(episode.outcome), **judgement_fields(episode.judgement), **timings}
    if words == LOOK_INSTRUCTION:
        figures["truth"] = looked
    contract = msgspec.to_builtins(episode.contract)
    return {"valid": True, **figures, "context": contract["context"], "actions": contract["action_sequence"]}


_OPEN_PLANNERS: dict[str, Planner] = {}


def _cached_planner(name: str) -> Planner:
    """The planner, opened once a process."""
    if name not in _OPEN_PLANNERS:
        from dualbrain.cli.common.paths import cache_folder  # noqa: PLC0415

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
    for planned, robot, words in dict.fromkeys((r["planned"], r["robot"], r["instruction"]) for r in rows):
        some = [r for r in rows if (r["planned"], r["robot"], r["instruction"]) == (planned, robot, words)]
        good = sum(bool(r.get("valid")) and succeeded(r) for r in some)
        found = ", ".join(f"{count} {kind}" for kind, count in count_violations(some).items()) or "none"
        cells.append(("planner" if planned else "template", robot, words, format_proportion(good, len(some)), found))
    return cells


def _compare_arms(rows: list[Row]) -> list[str]:
    """How many of the arms' pairs of contracts, for one instruction in one scene, have the same skills and values."""
    lines: list[str] = []
    for planned, word in ((False, "template"), (True, "planner")):
        pairs: dict[str, list[list[dict[str, Any]]]] = {}
        for r in rows:
            if "actions" in r and r["robot"] in ARMS and r["planned"] == planned:
                pairs.setdefault(r["key"].replace(r["robot"], "arm", 1), []).append(r["actions"])
        both = [pair for pair in pairs.values() if len(pair) == len(ARMS)]
        if both:
            shapes = sum(_skills_and_parameters(one) == _skills_and_parameters(other) for one, other in both)
            values = sum(one == other for one, other in both)
            lines.append(
                f"Arms' contracts by the {word} for the same words in the same scene: same skills and parameters in "
                f"**{format_proportion(shapes, len(both))}**, same values as well in **{format_proportion(values, len(both))}**."
            )
    return lines


def _skills_and_parameters(actions: list[dict[str, Any]]) -> list[tuple[str, list[str]]]:
    return [(action["skill"], sorted(action["params"])) for action in actions]


def _registry_differences() -> list[str]:
    """Where the two arms' registries differ in what gives contracts their meaning, entry by entry."""
    first, other = (
        _flatten(msgspec.json.decode(load_skill_registry(name).canonical_bytes())["skills"]) for name in ARMS
    )
    differing = [
        f"{key} ({first.get(key)} and {other.get(key)})"
        for key in {**first, **other}
        if first.get(key) != other.get(key)
    ]
    return [f"Of {len(first)} entries, {' and '.join(ARMS)}'s registries differ in: {'; '.join(differing) or 'none'}."]


def _flatten(value: Any, path: str = "") -> dict[str, Any]:
    """Every leaf under its path."""
    if not isinstance(value, dict):
        return {path: value}
    return {
        key: one for name, inner in value.items() for key, one in _flatten(inner, f"{path}.{name}".lstrip(".")).items()
    }
