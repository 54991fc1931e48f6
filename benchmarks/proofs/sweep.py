"""sweep: many valid contracts for one instruction in three hazardous families; does the contract matter?"""

from __future__ import annotations

from itertools import product
from typing import Any

from dualbrain.world.scenes import make_scene
from proofs.closed_loop import errand, fly, kinds, outcome_words, row, violation_words
from proofs.figures import share, table
from proofs.learnable import FAMILIES, verdicts
from proofs.proof import Options, Row, Unit

SEEDS = range(3)
AGAIN = range(2)
"""Scenes that are flown a second time with other perception noise: do the rankings repeat?"""
OTHER_NOISE = 100
SPEEDS = (0.2, 0.4, 0.1)
"""Most telling first: the bar is stated at fixed speed, and 0.2 m/s is the ordinary one."""
GRID = {
    "clearance": (0.08, 0.15, 0.30), "finger_axis": ("along", "across"), "route": ("direct", "near_base"),
    "approach": ("top", "tilted"),
}  # fmt: skip
"""24 contracts a speed; opening 0.08 m, no waiting, 20 N."""


class Sweep:
    """The loop has something to learn."""

    name = "sweep"
    claim = (
        "In three hazardous families, at fixed speed: worst and best Δ of successes differ threefold, rankings repeat "
        "under other noise (Spearman ≥ 0.5), success varies, and the best fixed contract has regret."
    )

    def units(self, options: Options) -> list[Unit]:
        """Speed by speed, seed by seed, every family in turn."""
        del options
        grid = [dict(zip(GRID, values, strict=True)) for values in product(*GRID.values())]
        return [
            self._unit(family, seed, speed, values, again=again)
            for speed in SPEEDS for again, seeds in ((False, SEEDS), (True, AGAIN)) for seed in seeds
            for values in grid for family in FAMILIES
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
        lines = table(
            ("family", "speed", "seeds", "contracts", "succeeded", "worst/best Δ", "Spearman, other noise",
             "Spearman, other scene", "regret of the best fixed", "bar"),
            (
                (v.family, v.speed, v.seeds, v.contracts, share(v.successes, v.episodes), v.ratio_words, v.rank_words,
                 v.across_words, v.regret_words, v.words)
                for v in verdicts(rows)
            ),
        )  # fmt: skip
        lines += [f"Violations in {len(rows)} episodes: {dict(kinds(rows)) or 'none'}.", ""]
        hurt = [row for row in rows if row.get("violations")]
        return lines + (
            table(("episode", "outcome", "violations"), ((r["key"], r["outcome"], violation_words(r)) for r in hurt))
            if hurt
            else []
        )

    @staticmethod
    def _unit(family: str, seed: int, speed: float, values: dict[str, Any], *, again: bool) -> Unit:
        parameters = {"speed": speed, **values}
        key = " ".join(str(value) for value in parameters.values())
        about = {"family": family, "seed": seed, "parameters": parameters, "again": again}
        return Unit(f"{family}:{seed} {key}" + (" again" if again else ""), about)
