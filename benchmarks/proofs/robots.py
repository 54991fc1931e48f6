"""robots: the same instructions on arms of two makes and, where they are about going somewhere, on a base."""

from __future__ import annotations

import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dualbrain.embodiment.body import load_body
from dualbrain.planner.protocol import Planner
from dualbrain.planner.registry import open_planner
from dualbrain.records import Scene
from dualbrain.world.arrival import At
from dualbrain.world.catalogue import open_scene
from dualbrain.world.open_plant import open_plant
from dualbrain.world.perception import EXACT, Perception
from dualbrain.world.scene_spec import SceneSpec
from dualbrain.world.task import Goal
from proofs.closed_loop import FORBIDDEN, fly, judgement_figures, kinds, outcome_words, row, succeeded, violation_words
from proofs.figures import share, table
from proofs.proof import Options, Row, Unit
from proofs.tasks import way_of

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
NEAR = 0.06
"""The tool looks at a thing from above when it is within this of it in the plane [m]."""


class Robots:
    """One contract space, filter and set of skills for bodies of different makes."""

    name = "robots"
    claim = "The same instructions succeed on every body without a collision; contracts differ in registry and bounds."

    def units(self, options: Options) -> list[Unit]:
        """Template contracts first; then the same with the planner's own, where one is named."""
        units = [Unit(_key("template", **about), {**about, "planner": ""}) for about in _abouts()]
        if options.planner:
            units += [Unit(_key("planned", **about), {**about, "planner": options.planner}) for about in _abouts()]
        return units

    def run(self, about: dict[str, Any]) -> Row:
        """Carry out one instruction."""
        spec, words = open_scene(about["scene"], about["robot"]), about["instruction"]
        if about["planner"]:
            return {**_planned(spec, about), **_about(about)}
        actions = template(_seen(spec), words)
        flight = fly(spec, actions, seed=spec.seed, goal=goal(words))
        truth = judgement_figures(flight.judgement)["truth"]
        if words == LOOK and flight.outcome is not None:
            away = flight.plant.tool_pose()[0][:2] - np.array(flight.plant.truth("blue_bowl").position[:2])
            truth = bool(np.linalg.norm(away) < NEAR)
        figures = row(flight)
        shape = [[action["skill"], sorted(action["params"])] for action in actions]
        return {**figures, **_about(about), **({"truth": truth} if figures["valid"] else {}), "shape": shape}

    def brief(self, row: Row) -> str:
        """How it ended."""
        return f"{row['robot']}, {row['instruction']}: {outcome_words(row)}"

    def report(self, rows: list[Row]) -> list[str]:
        """Success and violations by body, and every exception."""
        lines = [*table(("contract from", "robot", "instruction", "succeeded", "violations"), _counts(rows)), ""]
        bad = [r for r in rows if not (r.get("valid") and succeeded(r)) or _forbidden(r)]
        cells = ((r["key"], outcome_words(r), violation_words(r) or "none") for r in bad)
        lines += table(("not as claimed", "outcome", "violations"), cells) if bad else ["No exception."]
        return [*lines, "", f"Arms' template contracts have the same skills and parameters: **{_alike(rows)}**."]


def goal(words: str) -> Goal | At | None:
    """What an instruction means on truth; None for a look."""
    return {
        PUT: Goal("red_cube", "blue_bowl"), BRING: Goal("red_cube", "table_left"), "go to the shelf": At("shelf"),
        "bring yourself to the charger": At("charger"),
    }.get(words)  # fmt: skip


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
    """The whole loop as `dualbrain run` has it, with a memory of its own that is empty."""
    import time  # noqa: PLC0415

    from dualbrain.cli.folders import cache  # noqa: PLC0415
    from dualbrain.runtime.session import Onlooker, RunConfig, Session, Times  # noqa: PLC0415
    from proofs.closed_loop import outcome_figures  # noqa: PLC0415

    del spec
    with tempfile.TemporaryDirectory() as folder:
        config = RunConfig(
            about["instruction"], Path(folder) / "run", Path(folder) / "ledger.sqlite", cache(), about["robot"],
            about["scene"], about["planner"], visuals=False,
        )  # fmt: skip
        times = Times(time.monotonic, "2026-01-01T00:00:00+00:00", time.time)
        with Session(config, times, {}, _planner(about["planner"])) as session:
            episode = session.run(Onlooker()).episode
    if episode.contract is None:
        return {"valid": False, "reason": episode.outcome.reason, "truth": False, "violations": []}
    figures = {**outcome_figures(episode.outcome), **judgement_figures(episode.judgement)}
    if about["instruction"] == LOOK:
        figures["truth"] = episode.outcome.kind == "succeeded"
    return {"valid": True, **figures, "contract": episode.contract}


_PLANNERS: dict[str, Planner] = {}


def _planner(name: str) -> Planner:
    """The planner, opened once a process."""
    if name not in _PLANNERS:
        from dualbrain.cli.folders import cache  # noqa: PLC0415

        prefixes = cache() / "prefixes"
        prefixes.mkdir(parents=True, exist_ok=True)
        _PLANNERS[name] = open_planner(name, cache(), key="", prefixes=prefixes)
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


def _alike(rows: list[Row]) -> str:
    """In how many pairs of an instruction and a scene the arms' contracts have the same shape."""
    shapes: dict[str, set[bytes]] = {}
    for r in rows:
        if "shape" in r and r["robot"] in ARMS:
            key = r["key"].replace(r["robot"], "arm", 1)
            shapes.setdefault(key, set()).add(msgspec.json.encode(r["shape"]))
    return share(sum(len(found) == 1 for found in shapes.values()), len(shapes))
