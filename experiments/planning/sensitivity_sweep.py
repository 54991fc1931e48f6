"""sweep: many valid contracts for one instruction in three hazardous families of level II; does the contract matter?"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import product
from typing import Any

from dualbrain.simulation.scenes.generators.tabletop import make_scene
from experiments.engine.experiment import Options, Row, Unit
from experiments.figures.tables import share, table
from experiments.planning.contract_sensitivity import FAMILIES, verdicts
from experiments.planning.verdict_confusion import confusion_lines
from experiments.safety.closed_loop import errand, fly, kinds, outcome_words, row, violation_words

SEEDS = (*((seed, False) for seed in range(3)), *((seed, True) for seed in range(2)),
         *((seed, False) for seed in range(3, 6)), (2, True))  # fmt: skip
"""Seeds of scenes, and whether one is flown again with other perception noise (do the rankings repeat?)."""
OTHER_NOISE = 100
SPEEDS = (0.2, 0.4, 0.1)
"""Most telling first: the bar is stated at fixed speed, and 0.2 m/s is the ordinary one."""
COMMON = {"clearance": (0.08, 0.15, 0.30), "finger_axis": ("along", "across"), "route": ("direct", "near_base")}
LEVER = {
    "tall_ii": {"opening": (0.055, 0.08)}, "shelf_ii": {"approach": ("top", "tilted")},
    "forearm_ii": {"wait": ("none", "until_clear")},
}  # fmt: skip
"""24 contracts a family and speed: what all share, and the lever that its hazard is about; the rest as in `GRASP`."""


class Sweep:
    """The loop has something to learn."""

    name = "sensitivity_sweep"
    claim = (
        "In three hazardous families of level II, at fixed speed: worst and best Δ of successes differ threefold, "
        "rankings repeat under other noise (Spearman ≥ 0.5), success varies, and the best fixed contract has regret."
    )

    def units(self, options: Options) -> list[Unit]:
        """Speed by speed, seed by seed, every family in turn.

        A speed is 648 units; its first 360 are three scenes a family, two of them flown again.
        """
        del options
        return [
            self._unit(family, seed, speed, contract, again=again)
            for speed in SPEEDS for seed, again in SEEDS for contracts in zip(*map(grid, FAMILIES), strict=True)
            for family, contract in zip(FAMILIES, contracts, strict=True)
        ]  # fmt: skip

    def run(self, about: dict[str, Any]) -> Row:
        """Grasp and place; the same perception noise and the same 2 s of thinking for all contracts of a scene."""
        family, seed = about["family"], about["seed"]
        noise = seed + OTHER_NOISE * about["again"]
        flight = fly(make_scene(family, seed), errand(**about["parameters"]), seed=noise, hold=2.0)
        return {**about, **row(flight)}

    def brief(self, row: Row) -> str:
        """End and Δ."""
        return outcome_words(row)

    def report(self, rows: list[Row]) -> list[str]:
        """Success by family and speed, the four parts of the bar, every violation that must not be."""
        return learnable_lines(rows, FAMILIES)

    @staticmethod
    def _unit(family: str, seed: int, speed: float, values: dict[str, Any], *, again: bool) -> Unit:
        parameters = {"speed": speed, **values}
        key = " ".join(str(value) for value in parameters.values())
        about = {"family": family, "seed": seed, "parameters": parameters, "again": again}
        return Unit(f"{family}:{seed} {key}" + (" again" if again else ""), about)


def grid(family: str) -> list[dict[str, Any]]:
    """The contracts that are flown in a family, without their speed."""
    levers = {**COMMON, **LEVER[family]}
    return [dict(zip(levers, values, strict=True)) for values in product(*levers.values())]


def learnable_lines(rows: list[Row], families: Sequence[str]) -> list[str]:
    """The bar by family and speed, violations, and whether the robot's word is true."""
    lines = table(
        ("family", "speed", "seeds", "contracts", "succeeded", "worst/best Δ", "Spearman, other noise",
         "Spearman, other scene", "regret of the best fixed", "decline scenes", "bar"),
        (
            (v.family, v.speed, v.seeds, v.contracts, share(v.successes, v.episodes), v.ratio_words, v.rank_words,
             v.across_words, v.regret_words, v.decline_words, v.words)
            for v in verdicts(rows, families)
        ),
    )  # fmt: skip
    lines += [f"Violations in {len(rows)} episodes: {dict(kinds(rows)) or 'none'}.", ""]
    lines += confusion_lines(rows)
    hurt = [row for row in rows if row.get("violations")]
    cells = ((r["key"], r["outcome"], violation_words(r)) for r in hurt)
    return lines + (table(("episode", "outcome", "violations"), cells) if hurt else [])
