"""nights: the adapters that suites `paper`, `refusals` and `ablations` ask for, all of what a chain of rounds lived.

`adapted` is that of the last round; from the others a part of adaptation is left out. They are put into dualbrain's
home, so that a suite can name them:

    dualbrain evaluate --suite ablations --planner adapted=transformers:adapter:ID,adapted_no_kl=…
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

from dualbrain.adaptation.adapters.card import read_adapter_card
from dualbrain.adaptation.curation.dataset import read_dataset
from dualbrain.cli.adapters.registry import open_adapter_registry
from experiments.adaptation.round_chain import ABLATIONS, STEP_TIMES_FILE, RoundChain, total_step_time
from experiments.adaptation.rounds import N_ROUNDS, Rounds
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table

FULL_ADAPTER = "adapted"


class SuiteAdapters:
    """One night with everything, and one without each part."""

    name = "suite_adapters"
    claim = (
        f"What {N_ROUNDS} rounds lived, taught once more without the entropy term, without the KL term, without "
        "physical selection, and selected by success alone: the adapters of the ablations. All their memories have one "
        "weight, so that λ_w tells no samples apart in any of them, and none is without it."
    )
    intervals = "none"

    def units(self, options: Options) -> list[WorkUnit]:
        """An adapter each, of the flights of the first chain of `rounds`."""
        folder = str(options.folder / Rounds.name)
        return [WorkUnit(part, {"part": part, "folder": folder}) for part in (FULL_ADAPTER, *ABLATIONS)]

    def run(self, about: dict[str, Any]) -> Row:
        """Live the rounds as far as they are not, fit, and put the adapter where suites find it."""
        part = about["part"]
        folder = adapter_folder(part, Path(about["folder"]))
        card, data = read_adapter_card(folder), read_dataset(folder.parent / "dataset")
        open_adapter_registry().add(folder, now=time.time())
        return {
            "part": part,
            "adapter": card.id,
            "samples": data.card.train,
            "dataset": card.dataset,
            "left_out": data.card.left_out,
            "steps": card.steps,
            "fit_s": total_step_time(folder.parent / STEP_TIMES_FILE),
        }

    def summarize_row(self, row: Row) -> str:
        """Which adapter it is."""
        return f"{row['adapter'][:16]}, {row['samples']} samples"

    def report(self, rows: list[Row]) -> list[str]:
        """A line an adapter."""
        return markdown_table(
            ("part", "adapter", "samples taught", "steps", "fit [s]", "left out"),
            (
                (
                    row["part"],
                    row["adapter"][:16],
                    row["samples"],
                    row["steps"],
                    f"{row['fit_s']:.0f}",
                    ", ".join(f"{number} {reason}" for reason, number in row["left_out"].items()),
                )
                for row in rows
            ),
        )


def adapter_folder(part: str, folder: Path) -> Path:
    """The adapter's folder, of the first chain in the folder of `rounds`; what is not fitted yet is."""
    chain = RoundChain(0, folder / "chain 0")
    return chain.adapter_folder(N_ROUNDS) if part == FULL_ADAPTER else chain.ablated_adapter_folder(N_ROUNDS, part)
