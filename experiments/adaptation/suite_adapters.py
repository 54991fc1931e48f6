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
from dualbrain.cli.adapters.registry import registry_of_adapters
from experiments.adaptation.round_chain import SECONDS, WITHOUT, Chain, seconds
from experiments.adaptation.rounds import ROUNDS, Rounds
from experiments.engine.experiment import Options, Row, Unit
from experiments.figures.tables import table

WHOLE = "adapted"


class Nights:
    """One night with everything, and one without each part."""

    name = "suite_adapters"
    claim = (
        f"What {ROUNDS} rounds lived, taught once more without the entropy term, without the KL term, without "
        "physical selection, and selected by success alone: the adapters of the ablations. All their memories have one "
        "weight, so that λ_w tells no samples apart in any of them, and none is without it."
    )
    intervals = "none"

    def units(self, options: Options) -> list[Unit]:
        """An adapter each, of the flights of the first chain of `rounds`."""
        folder = str(options.folder / Rounds.name)
        return [Unit(part, {"part": part, "folder": folder}) for part in (WHOLE, *WITHOUT)]

    def run(self, about: dict[str, Any]) -> Row:
        """Live the rounds as far as they are not, fit, and put the adapter where suites find it."""
        part = about["part"]
        folder = fitted(part, Path(about["folder"]))
        card, data = read_adapter_card(folder), read_dataset(folder.parent / "dataset")
        registry_of_adapters().add(folder, now=time.time())
        return {
            "part": part, "adapter": card.id, "samples": data.card.train, "dataset": card.dataset,
            "left_out": data.card.left_out, "steps": card.steps, "fit_s": seconds(folder.parent / SECONDS),
        }  # fmt: skip

    def brief(self, row: Row) -> str:
        """Which adapter it is."""
        return f"{row['adapter'][:16]}, {row['samples']} samples"

    def report(self, rows: list[Row]) -> list[str]:
        """A line an adapter."""
        return table(
            ("part", "adapter", "samples taught", "steps", "fit [s]", "left out"),
            ((row["part"], row["adapter"][:16], row["samples"], row["steps"], f"{row['fit_s']:.0f}",
              ", ".join(f"{number} {reason}" for reason, number in row["left_out"].items())) for row in rows),
        )  # fmt: skip


def fitted(part: str, folder: Path) -> Path:
    """The adapter's folder, of the first chain in the folder of `rounds`; what is not fitted yet is."""
    chain = Chain(0, folder / "chain 0")
    return chain.adapter(ROUNDS) if part == WHOLE else chain.without(ROUNDS, part)
