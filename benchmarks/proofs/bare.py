"""bare: with nothing in the way the filter has nothing to say, whatever the contract's parameters are."""

from __future__ import annotations

from itertools import product
from typing import Any

import numpy as np

from dualbrain.world.scenes import make_scene
from proofs.closed_loop import errand, fly, kinds, outcome_words, row, succeeded, violation_words
from proofs.figures import share, table
from proofs.proof import Options, Row, Unit

GRID = {
    "speed": (0.05, 0.2, 0.4), "clearance": (0.03, 0.15, 0.35), "finger_axis": ("along", "across"),
    "opening": (0.06, 0.08), "approach": ("top", "tilted", "side"),
    "route": ("direct", "near_base", "left", "right"), "wait": ("none", "until_clear"),
}  # fmt: skip
SCENES = 20
"""Bare scenes over which the grid is dealt out."""
SAMPLE = 216
"""How many of the 864 contracts are carried out unless more are asked for: a seeded sample, a quarter of the grid."""


class Bare:
    """δ measures hazards, not our trajectory generator."""

    name = "bare"
    claim = "On the bare scene every valid contract succeeds in time with δ = 0 on every tick."

    def units(self, options: Options) -> list[Unit]:
        """The whole grid in a seeded order, cut to the sample."""
        del options
        grid = [dict(zip(GRID, values, strict=True)) for values in product(*GRID.values())]
        order = np.random.default_rng(2026).permutation(len(grid))[:SAMPLE]
        return [self._unit(grid[index], place % SCENES) for place, index in enumerate(order.tolist())]

    def run(self, about: dict[str, Any]) -> Row:
        """Grasp and place."""
        flight = fly(make_scene("bare", about["seed"]), errand(**about["parameters"]), seed=about["seed"])
        return {**row(flight), "parameters": about["parameters"]}

    def brief(self, row: Row) -> str:
        """End and largest δ."""
        return f"{outcome_words(row)}" + (f", largest δ {row['delta_max']:.2g}" if row["valid"] else "")

    def report(self, rows: list[Row]) -> list[str]:
        """The counts, and every exception."""
        valid = [row for row in rows if row["valid"]]
        clean = [row for row in valid if succeeded(row) and row["delta_max"] == 0.0]
        refused = len(rows) - len(valid)
        lines = [
            f"Valid contracts that succeeded in time with δ = 0 on every tick: **{share(len(clean), len(valid))}**.",
            f"Succeeded: {share(sum(map(succeeded, valid)), len(valid))}; "
            f"δ = 0 on every tick: {share(sum(row['delta_max'] == 0.0 for row in valid), len(valid))}; "
            f"the gate refused {refused} of {len(rows)} (not valid for their scene).",
            f"Violations: {dict(kinds(valid)) or 'none'}.", "",
        ]  # fmt: skip
        odd = [row for row in valid if row not in clean]
        cells = ((r["key"], r["outcome"], r["reason"], f"{r['delta_max']:.2g}", violation_words(r)) for r in odd)
        return [*lines, *(table(("contract", "outcome", "reason", "largest δ", "violations"), cells) if odd else [])]

    @staticmethod
    def _unit(parameters: dict[str, Any], seed: int) -> Unit:
        key = " ".join(str(value) for value in parameters.values())
        return Unit(f"bare:{seed} {key}", {"parameters": parameters, "seed": seed})
