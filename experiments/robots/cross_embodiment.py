"""robots: the same instructions on arms of two makes and, where they are about going somewhere, on a base."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dualbrain.grounding.vocabulary import vocabulary
from dualbrain.planner.protocol import Planner
from dualbrain.planner.registry import open_planner
from dualbrain.records import Scene
from dualbrain.robots.loader import load_body
from dualbrain.simulation.perception.noisy_perception import EXACT, Perception
from dualbrain.simulation.plant.factory import open_plant
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from dualbrain.simulation.tasks.placement import goal_of
from experiments.engine.experiment import Options, Row, Unit
from experiments.figures.tables import share, table
from experiments.planning.competent_contracts import way_of
from experiments.safety.closed_loop import (
    FORBIDDEN,
    fly,
    judgement_figures,
    kinds,
    outcome_words,
    row,
    succeeded,
    violation_words,
)

ARMS = ("panda", "ur5e")
SCENES = 20
FAMILIES = ("bare", "tabletop", "shelf", "forearm")
"""Scene k of an arm is of family k mod 4 (seed k); that of a base of kind k mod 3."""
PUT, BRING, LOOK = (
    "put the red cube in the blue bowl",
    "put the red cube on table_left",
    "look at the blue bowl from above",
)
INSTRUCTIONS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(ARMS, (PUT, BRING, LOOK)), "base": ("go to the shelf", "bring yourself to the charger"),
}  # fmt: skip
GRIP = 20.0
"""Grip force that every gripper here has [N]."""
PATIENCE = 3600.0
"""With the planner, so that a busy machine is not taken for a planner that cannot [s]."""
NEAR = 0.06
"""The tool looks at a thing from above when it is within this of it in the plane [m]."""


class Robots:
    """One contract space, filter and set of skills for bodies of different makes."""

    name = "cross_embodiment"
    claim = "The same instructions succeed on every body without a collision; contracts differ in registry and bounds."

    def units(self, options: Options) -> list[Unit]:
        """Template contracts first; then the same with the planner's own, where one is named.

        The planner's go robot by robot, because it reads each robot's rules once and keeps only the last it read.
        """
        units = [Unit(_key("template", **about), {**about, "planner": ""}) for about in _abouts()]
        if options.planner:
            by_robot = sorted(_abouts(), key=lambda about: list(INSTRUCTIONS)[::-1].index(about["robot"]))
            units += [Unit(_key("planned", **about), {**about, "planner": options.planner}) for about in by_robot]
        return units

    def run(self, about: dict[str, Any]) -> Row:
        """Carry out one instruction."""
        spec, words = open_scene(about["scene"], about["robot"]), about["instruction"]
        if about["planner"]:
            return {**_planned(spec, about), **_about(about)}
        actions = template(_seen(spec), words)
        flight = fly(spec, actions, seed=spec.seed, goal=None if words == LOOK else goal_of(words, spec))
        figures = {**row(flight), **_about(about), "actions": actions}
        if words == LOOK and flight.outcome is not None:
            figures["truth"] = looks(flight.plant)
        return figures

    def brief(self, row: Row) -> str:
        """How it ended."""
        return f"{row['robot']}, {row['instruction']}: {outcome_words(row)}"

    def report(self, rows: list[Row]) -> list[str]:
        """Success and violations by body, and every exception."""
        lines = [*table(("contract from", "robot", "instruction", "succeeded", "violations"), _counts(rows)), ""]
        bad = [r for r in rows if not (r.get("valid") and succeeded(r)) or _forbidden(r)]
        cells = ((r["key"], outcome_words(r), violation_words(r) or "none") for r in bad)
        lines += table(("not as claimed", "outcome", "violations"), cells) if bad else ["No exception."]
        return [*lines, "", *_compared(rows), "", *_registries()]


def looks(plant: Plant) -> bool:
    """Whether the tool is over the bowl, on truth."""
    away = plant.tool_pose()[0][:2] - np.array(plant.truth("blue_bowl").position[:2])
    return bool(np.linalg.norm(away) < NEAR)


def template(scene: Scene, words: str) -> list[dict[str, Any]]:
    """The contract that the prompt's rules make of an instruction, whatever the arm."""
    if scene.region:
        place = "shelf" if "shelf" in words else "charger"
        return [{"skill": "drive_to", "params": {"place": place, "max_speed": 0.4, "max_turn_rate": 1.0}}]
    way, grasp = way_of(scene, "red_cube")
    if words == LOOK:
        return [{"skill": "move_to", "params": {"target": "blue_bowl", "speed": 0.2, **way}}]
    destination = "blue_bowl" if words == PUT else "table_left"
    place = {"destination": destination, "speed": 0.2, **way}
    return [{"skill": "grasp", "params": {**grasp, "force": GRIP}}, {"skill": "place", "params": place}]


def _seen(spec: SceneSpec) -> Scene:
    """The scene as it is at the start, exactly."""
    plant = open_plant(spec, load_body(spec.robot))
    return Perception(spec, EXACT, np.random.default_rng(0)).look(plant)


def _abouts() -> Iterator[dict[str, str]]:
    for k in range(SCENES):
        for robot, instructions in INSTRUCTIONS.items():
            scene = str(k) if robot == "base" else f"{FAMILIES[k % len(FAMILIES)]}:{k}"
            for instruction in instructions:
                yield {"robot": robot, "scene": scene, "instruction": instruction}


def _key(how: str, robot: str, scene: str, instruction: str) -> str:
    return f"{how} {robot} {scene} {instruction}"


def _about(about: dict[str, Any]) -> Row:
    return {"robot": about["robot"], "instruction": about["instruction"], "planned": bool(about["planner"])}


def _planned(spec: SceneSpec, about: dict[str, Any]) -> Row:
    """The whole loop as `dualbrain run` has it, with a memory of its own that is empty; judged by the instruction."""
    import time  # noqa: PLC0415

    from dualbrain.cli.common.paths import cache  # noqa: PLC0415
    from dualbrain.runtime.session import Onlooker, RunConfig, Session, Times  # noqa: PLC0415
    from experiments.safety.closed_loop import outcome_figures  # noqa: PLC0415

    words = about["instruction"]
    with tempfile.TemporaryDirectory() as folder:
        config = RunConfig(
            words, Path(folder) / "run", Path(folder) / "ledger.sqlite", cache(), about["robot"],
            about["scene"], about["planner"], visuals=False, goal="" if words == LOOK else words,
        )  # fmt: skip
        times = Times(time.monotonic, "2026-01-01T00:00:00+00:00", time.time)
        with Session(config, times, {}, _planner(about["planner"])) as session:
            episode = session.run(Onlooker()).episode
            looked = words == LOOK and looks(session.plant)
    timings = {"shots": len(episode.attempts), "timings": msgspec.to_builtins(episode.timings)}
    if episode.contract is None:
        return {"valid": False, "reason": episode.outcome.reason, "truth": False, "violations": [], **timings}
    figures = {**outcome_figures(episode.outcome), **judgement_figures(episode.judgement), **timings}
    if words == LOOK:
        figures["truth"] = looked
    contract = msgspec.to_builtins(episode.contract)
    return {"valid": True, **figures, "context": contract["context"], "actions": contract["action_sequence"]}


_PLANNERS: dict[str, Planner] = {}


def _planner(name: str) -> Planner:
    """The planner, opened once a process."""
    if name not in _PLANNERS:
        from dualbrain.cli.common.paths import cache  # noqa: PLC0415

        prefixes = cache() / "prefixes"
        prefixes.mkdir(parents=True, exist_ok=True)
        _PLANNERS[name] = open_planner(name, cache(), key="", timeout_s=PATIENCE, prefixes=prefixes)
    return _PLANNERS[name]


def _forbidden(row: Row) -> bool:
    return any(violation["kind"] in FORBIDDEN for violation in row.get("violations", ()))


def _counts(rows: list[Row]) -> list[tuple[str, ...]]:
    cells: list[tuple[str, ...]] = []
    for planned, robot, words in dict.fromkeys((r["planned"], r["robot"], r["instruction"]) for r in rows):
        some = [r for r in rows if (r["planned"], r["robot"], r["instruction"]) == (planned, robot, words)]
        good = sum(bool(r.get("valid")) and succeeded(r) for r in some)
        found = ", ".join(f"{count} {kind}" for kind, count in kinds(some).items()) or "none"
        cells.append(("planner" if planned else "template", robot, words, share(good, len(some)), found))
    return cells


def _compared(rows: list[Row]) -> list[str]:
    """How many of the arms' pairs of contracts, for one instruction in one scene, have the same skills and values."""
    lines: list[str] = []
    for planned, word in ((False, "template"), (True, "planner")):
        pairs: dict[str, list[list[dict[str, Any]]]] = {}
        for r in rows:
            if "actions" in r and r["robot"] in ARMS and r["planned"] == planned:
                pairs.setdefault(r["key"].replace(r["robot"], "arm", 1), []).append(r["actions"])
        both = [pair for pair in pairs.values() if len(pair) == len(ARMS)]
        if both:
            shapes = sum(_shape(one) == _shape(other) for one, other in both)
            values = sum(one == other for one, other in both)
            lines.append(
                f"Arms' contracts by the {word} for the same words in the same scene: same skills and parameters in "
                f"**{share(shapes, len(both))}**, same values as well in **{share(values, len(both))}**."
            )
    return lines


def _shape(actions: list[dict[str, Any]]) -> list[tuple[str, list[str]]]:
    return [(action["skill"], sorted(action["params"])) for action in actions]


def _registries() -> list[str]:
    """Where the two arms' registries differ in what gives contracts their meaning, entry by entry."""
    first, other = (_entries(msgspec.json.decode(vocabulary(name).canonical())["skills"]) for name in ARMS)
    differing = [
        f"{key} ({first.get(key)} and {other.get(key)})"
        for key in {**first, **other} if first.get(key) != other.get(key)
    ]  # fmt: skip
    return [f"Of {len(first)} entries, {' and '.join(ARMS)}'s registries differ in: {'; '.join(differing) or 'none'}."]


def _entries(value: Any, path: str = "") -> dict[str, Any]:
    """Every leaf under its path."""
    if not isinstance(value, dict):
        return {path: value}
    return {
        key: one for name, inner in value.items() for key, one in _entries(inner, f"{path}.{name}".lstrip(".")).items()
    }
