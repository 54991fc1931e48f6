"""The adapters of the suites `paper`, `refusals` and `ablations`, all trained on the data of one chain of rounds.

`adapted` is that of the last round; each of the others leaves out one part of adaptation. They are added to dualbrain's
registry of adapters, so that a suite can name them:

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
    """The complete adaptation, and one training run without each of its parts."""

    name = "suite_adapters"
    claim = (
        f"The data of {N_ROUNDS} rounds, trained on again without the entropy term, without the KL term, without "
        "physical selection, and selected by success alone: the adapters of the ablations. All memories have the same "
        "weight, so λ_w distinguishes no samples in any of them, and no adapter leaves it out."
    )
    intervals = "none"

    def units(self, options: Options) -> list[WorkUnit]:
        """One unit per adapter, from the episodes of the first chain of `rounds`."""
        folder = str(options.folder / Rounds.name)
        return [WorkUnit(part, {"part": part, "folder": folder}) for part in (FULL_ADAPTER, *ABLATIONS)]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Run the rounds that are missing, train the adapter, and register it."""
        part = parameters["part"]
        folder = adapter_folder(part, Path(parameters["folder"]))
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
        """The adapter's id and its number of samples."""
        return f"{row['adapter'][:16]}, {row['samples']} samples"

    def report(self, rows: list[Row]) -> list[str]:
        """A line per adapter."""
        return markdown_table(
            ("role", "adapter", "training samples", "steps", "training time [s]", "left out"),
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
    """The folder of an adapter from the first chain in the folder of `rounds`; it is trained if it is missing."""
    chain = RoundChain(0, folder / "chain 0")
    return chain.adapter_folder(N_ROUNDS) if part == FULL_ADAPTER else chain.ablated_adapter_folder(N_ROUNDS, part)
