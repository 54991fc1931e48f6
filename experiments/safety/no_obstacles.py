"""Scenes without obstacles: the filter does not intervene, for any valid parameters of a contract."""

from __future__ import annotations

from itertools import product
from typing import Any

import msgspec
import numpy as np

from dualbrain.simulation.scenes.generators.tabletop import make_scene
from dualbrain.simulation.scenes.scene_spec import SceneSpec
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_proportion, markdown_table
from experiments.safety.closed_loop import (
    PICK_AND_PLACE_GOAL,
    count_violations,
    describe_outcome,
    describe_violations,
    pick_and_place_actions,
    run_contract,
    run_row,
    succeeded,
)

SPEED, CLEARANCE = (0.05, 0.2, 0.4), (0.03, 0.15, 0.35)
ROUTE, WAIT = ("direct", "near_base", "left", "right"), ("none", "until_clear")
PICK_AND_PLACE_GRID = {
    "speed": SPEED,
    "clearance": CLEARANCE,
    "finger_axis": ("along", "across"),
    "opening": (0.06, 0.08),
    "approach": ("top", "tilted", "side"),
    "route": ROUTE,
    "wait": WAIT,
}
"""grasp and place: both ends and a middle value of every range, every value of every choice."""
MOVE_TO_GRID = {
    "target": ("red_cube", "blue_bowl", "table_left"),
    "speed": SPEED,
    "clearance": CLEARANCE,
    "route": ROUTE,
    "wait": WAIT,
}
"""move_to, with nothing but the target on the table."""
TOUR_GRID = {"speed": SPEED, "duration": (0.5, 3.0), "seed": range(6)}
"""grasp, hold, home, hold, release, home: the other skills, with and without a load."""
N_SCENES = 20
"""Number of scenes without obstacles over which the grids are distributed."""


class NoObstacles:
    """δ measures hazards, not artefacts of the trajectory generator."""

    name = "no_obstacles"
    claim = "In a scene without obstacles, every valid contract succeeds in time with δ = 0 in every tick."

    def units(self, options: Options) -> list[WorkUnit]:
        """Every contract of the three grids, in a seeded order."""
        del options
        units = [_pick_and_place_unit(place, values) for place, values in enumerate(_shuffled(PICK_AND_PLACE_GRID))]
        units += [_move_unit(place, values) for place, values in enumerate(_shuffled(MOVE_TO_GRID))]
        units += [_tour_unit(values) for values in _shuffled(TOUR_GRID)]
        order = np.random.default_rng(7).permutation(len(units))
        return [units[index] for index in order.tolist()]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Run one contract; only pick and place has a goal that ground truth can judge."""
        goal = PICK_AND_PLACE_GOAL if parameters["errand"] else None
        run = run_contract(
            _scene(parameters["seed"], parameters["only"]), parameters["actions"], seed=parameters["seed"], goal=goal
        )
        row = run_row(run)
        return {**row, "grid": parameters["grid"], "truth": row.get("truth", False) if goal else True}

    def summarize_row(self, row: Row) -> str:
        """The outcome and the largest δ."""
        return f"{describe_outcome(row)}" + (f", largest δ {row['delta_max']:.2g}" if row["valid"] else "")

    def report(self, rows: list[Row]) -> list[str]:
        """The counts by grid, and every exception."""
        valid = [row for row in rows if row["valid"]]
        clean = [row for row in valid if succeeded(row) and row["delta_max"] == 0.0]
        share = format_proportion(len(clean), len(valid))
        head = ("grid", "contracts", "rejected by the gate", "succeeded", "δ = 0 in every tick")
        lines = [
            f"Valid contracts that succeeded in time with δ = 0 in every tick: **{share}**.",
            f"Violations: {dict(count_violations(valid)) or 'none'}.",
            "",
            *markdown_table(head, _counts(rows)),
        ]
        others = [row for row in valid if row not in clean]
        cells = ((r["key"], r["outcome"], r["reason"], f"{r['delta_max']:.2g}", describe_violations(r)) for r in others)
        return [
            *lines,
            "",
            *(markdown_table(("contract", "outcome", "reason", "largest δ", "violations"), cells) if others else []),
        ]


def _counts(rows: list[Row]) -> list[tuple[str, ...]]:
    return [
        _count(grid, [one for one in rows if one["grid"] == grid]) for grid in dict.fromkeys(r["grid"] for r in rows)
    ]


def _count(grid: str, rows: list[Row]) -> tuple[str, ...]:
    valid = [one for one in rows if one["valid"]]
    untouched = sum(one["delta_max"] == 0.0 for one in valid)
    return (grid, *map(str, (len(rows), len(rows) - len(valid), sum(map(succeeded, valid)), untouched)))


def _shuffled(grid: dict[str, Any]) -> list[dict[str, Any]]:
    """All combinations in a seeded order, so that any prefix is an unbiased sample."""
    every = [dict(zip(grid, values, strict=True)) for values in product(*grid.values())]
    return [every[index] for index in np.random.default_rng(2026).permutation(len(every)).tolist()]


def _scene(seed: int, only: str | None) -> SceneSpec:
    """A scene without obstacles; with `only`, it contains nothing but the table and that object."""
    spec = make_scene("bare", seed)
    if only is None:
        return spec
    return msgspec.structs.replace(spec, objects=tuple(one for one in spec.objects if one.name in ("table", only)))


def _unit(grid: str, key: str, seed: int, actions: list[dict[str, Any]], only: str | None = None) -> WorkUnit:
    parameters = {"grid": grid, "errand": grid == "errand", "seed": seed, "actions": actions, "only": only}
    return WorkUnit(f"{grid} bare:{seed} {key}", parameters)


def _key_text(values: dict[str, Any]) -> str:
    return " ".join(str(value) for value in values.values())


def _pick_and_place_unit(place: int, values: dict[str, Any]) -> WorkUnit:
    return _unit("errand", _key_text(values), place % N_SCENES, pick_and_place_actions(**values))


def _move_unit(place: int, values: dict[str, Any]) -> WorkUnit:
    only = values["target"]
    return _unit("move_to", _key_text(values), place % N_SCENES, [{"skill": "move_to", "params": values}], only)


def _tour_unit(values: dict[str, Any]) -> WorkUnit:
    pause = {"skill": "hold", "params": {"duration": values["duration"]}}
    home = {"skill": "home", "params": {"speed": values["speed"]}}
    release = {"skill": "release", "params": {"speed": values["speed"]}}
    grasp = pick_and_place_actions(speed=values["speed"])[0]
    actions = [grasp, pause, home, pause, release, home]
    return _unit("tour", _key_text(values), values["seed"], actions, "red_cube")
