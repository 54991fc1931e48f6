"""Many valid contracts for one instruction in three hazardous families of level II: do the parameters matter?"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

from dualbrain.simulation.scenes.generators.tabletop import make_scene
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_proportion, markdown_table
from experiments.planning.contract_sensitivity import FAMILIES, evaluate_sensitivity
from experiments.planning.verdict_confusion import confusion_table
from experiments.safety.closed_loop import (
    count_violations,
    describe_outcome,
    describe_violations,
    pick_and_place_actions,
    run_contract,
    run_row,
)

SEEDS = (
    *((seed, False) for seed in range(3)),
    *((seed, True) for seed in range(2)),
    *((seed, False) for seed in range(3, 6)),
    (2, True),
)
"""Seeds of scenes, and whether a scene is repeated with other perception noise (do the rankings repeat?)."""
NOISE_SEED_OFFSET = 100
SPEEDS = (0.2, 0.4, 0.1)
"""Speeds, the typical one first: the criteria are stated at fixed speed [m/s]."""
COMMON_PARAMETERS = {
    "clearance": (0.08, 0.15, 0.30),
    "finger_axis": ("along", "across"),
    "route": ("direct", "near_base"),
}
FAMILY_PARAMETERS = {
    "tall_ii": {"opening": (0.055, 0.08)},
    "shelf_ii": {"approach": ("top", "tilted")},
    "forearm_ii": {"wait": ("none", "until_clear")},
}
"""24 contracts per family and speed: the common parameters, and the one that concerns the family's hazard."""


class SensitivitySweep:
    """Contract parameters matter, so there is something to learn."""

    name = "sensitivity_sweep"
    claim = (
        "In three hazardous families of level II, at fixed speed: the worst and the best Δ of successes differ "
        "threefold, rankings repeat under other noise (Spearman ≥ 0.5), success varies, and the best fixed contract "
        "has regret."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Speed by speed, seed by seed, every family in turn.

        Each speed has 648 units; the first 360 are three scenes per family, two of them with repetition.
        """
        del options
        return [
            self._unit(family, seed, speed, contract, again=again)
            for speed in SPEEDS
            for seed, again in SEEDS
            for contracts in zip(*map(contract_grid, FAMILIES), strict=True)
            for family, contract in zip(FAMILIES, contracts, strict=True)
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Grasp and place; all contracts of a scene have the same perception noise and 2 s of planning time."""
        family, seed = parameters["family"], parameters["seed"]
        noise = seed + NOISE_SEED_OFFSET * parameters["again"]
        run = run_contract(
            make_scene(family, seed), pick_and_place_actions(**parameters["parameters"]), seed=noise, settle_s=2.0
        )
        return {**parameters, **run_row(run)}

    def summarize_row(self, row: Row) -> str:
        """The outcome and Δ."""
        return describe_outcome(row)

    def report(self, rows: list[Row]) -> list[str]:
        """Success by family and speed, the four criteria, every violation."""
        return sensitivity_tables(rows, FAMILIES)

    @staticmethod
    def _unit(family: str, seed: int, speed: float, values: dict[str, Any], *, again: bool) -> WorkUnit:
        parameters = {"speed": speed, **values}
        key = " ".join(str(value) for value in parameters.values())
        unit_parameters = {"family": family, "seed": seed, "parameters": parameters, "again": again}
        return WorkUnit(f"{family}:{seed} {key}" + (" again" if again else ""), unit_parameters)


def contract_grid(family: str) -> list[dict[str, Any]]:
    """The contracts of a family, without their speed."""
    grid = {**COMMON_PARAMETERS, **FAMILY_PARAMETERS[family]}
    return [dict(zip(grid, values, strict=True)) for values in product(*grid.values())]


def sensitivity_tables(rows: list[Row], families: Sequence[str]) -> list[str]:
    """The criteria by family and speed, violations, and the robot's reports against ground truth."""
    lines = markdown_table(
        (
            "family",
            "speed",
            "seeds",
            "contracts",
            "succeeded",
            "worst/best Δ",
            "Spearman, other noise",
            "Spearman, other scene",
            "regret of the best fixed",
            "infeasible scenes",
            "criteria",
        ),
        (
            (
                v.family,
                v.speed,
                v.seeds,
                v.contracts,
                format_proportion(v.successes, v.episodes),
                v.ratio_text,
                v.noise_text,
                v.cross_scene_text,
                v.regret_text,
                v.unsolved_text,
                v.verdict_text,
            )
            for v in evaluate_sensitivity(rows, families)
        ),
    )
    lines += [f"Violations in {len(rows)} episodes: {dict(count_violations(rows)) or 'none'}.", ""]
    lines += confusion_table(rows)
    violating = [row for row in rows if row.get("violations")]
    cells = ((r["key"], r["outcome"], describe_violations(r)) for r in violating)
    return lines + (markdown_table(("episode", "outcome", "violations"), cells) if violating else [])
