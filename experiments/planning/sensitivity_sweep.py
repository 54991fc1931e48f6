"""sweep: many valid contracts for one instruction in three hazardous families of level II; does the contract matter?"""

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
"""Seeds of scenes, and whether one is flown again with other perception noise (do the rankings repeat?)."""
NOISE_SEED_OFFSET = 100
SPEEDS = (0.2, 0.4, 0.1)
"""Most telling first: the bar is stated at fixed speed, and 0.2 m/s is the ordinary one."""
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
"""24 contracts a family and speed: what all share, and the lever that its hazard is about; the rest as in `GRASP`."""


class SensitivitySweep:
    """The loop has something to learn."""

    name = "sensitivity_sweep"
    claim = (
        "In three hazardous families of level II, at fixed speed: worst and best Δ of successes differ threefold, "
        "rankings repeat under other noise (Spearman ≥ 0.5), success varies, and the best fixed contract has regret."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """Speed by speed, seed by seed, every family in turn.

        A speed is 648 units; its first 360 are three scenes a family, two of them flown again.
        """
        del options
        return [
            self._unit(family, seed, speed, contract, again=again)
            for speed in SPEEDS
            for seed, again in SEEDS
            for contracts in zip(*map(contract_grid, FAMILIES), strict=True)
            for family, contract in zip(FAMILIES, contracts, strict=True)
        ]

    def run(self, about: dict[str, Any]) -> Row:
        """Grasp and place; the same perception noise and the same 2 s of thinking for all contracts of a scene."""
        family, seed = about["family"], about["seed"]
        noise = seed + NOISE_SEED_OFFSET * about["again"]
        flight = run_contract(
            make_scene(family, seed), pick_and_place_actions(**about["parameters"]), seed=noise, settle_s=2.0
        )
        return {**about, **run_row(flight)}

    def summarize_row(self, row: Row) -> str:
        """End and Δ."""
        return describe_outcome(row)

    def report(self, rows: list[Row]) -> list[str]:
        """Success by family and speed, the four parts of the bar, every violation that must not be."""
        return sensitivity_tables(rows, FAMILIES)

    @staticmethod
    def _unit(family: str, seed: int, speed: float, values: dict[str, Any], *, again: bool) -> WorkUnit:
        parameters = {"speed": speed, **values}
        key = " ".join(str(value) for value in parameters.values())
        about = {"family": family, "seed": seed, "parameters": parameters, "again": again}
        return WorkUnit(f"{family}:{seed} {key}" + (" again" if again else ""), about)


def contract_grid(family: str) -> list[dict[str, Any]]:
    """The contracts that are flown in a family, without their speed."""
    levers = {**COMMON_PARAMETERS, **FAMILY_PARAMETERS[family]}
    return [dict(zip(levers, values, strict=True)) for values in product(*levers.values())]


def sensitivity_tables(rows: list[Row], families: Sequence[str]) -> list[str]:
    """The bar by family and speed, violations, and whether the robot's word is true."""
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
            "decline scenes",
            "bar",
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
    hurt = [row for row in rows if row.get("violations")]
    cells = ((r["key"], r["outcome"], describe_violations(r)) for r in hurt)
    return lines + (markdown_table(("episode", "outcome", "violations"), cells) if hurt else [])
