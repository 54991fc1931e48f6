"""dualbrain adapt: what the ledger would teach, and fitting an adapter on it."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

from cyclopts import Parameter
from rich.table import Table

from dualbrain.cli.console import Account
from dualbrain.cli.exits import Exit
from dualbrain.cli.memory_open import reader, tell

Flag = Annotated[bool, Parameter(negative="")]


def adapt(
    *, robot: str = "panda", ledger: Path | None = None, config: Path | None = None, export: Path | None = None,
    dry_run: Flag = False, json: Flag = False,
) -> int:  # fmt: skip
    """Learn from what went well: choose the clean episodes of a robot and fit an adapter of the planner on them.

    Clean are believed successes of this robot and vocabulary with little intervention, not slower than their kind; not
    one in which a person's hand was. Nothing in memory is changed.

    Parameters
    ----------
    robot
        Whose planner.
    ledger
        Which memory; default in dualbrain's home.
    config
        A TOML file with the dials.
    export
        Write the data set there (JSON lines in prompt-completion form, and its card), and fit nothing.
    dry_run
        Only say what would be used, and what not and why.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.adaptation.config import AdaptConfig, read_config
    from dualbrain.adaptation.curate import curate
    from dualbrain.adaptation.dataset import dataset_of, write_dataset
    from dualbrain.runtime.vocabulary import vocabulary

    dials = read_config(config) if config else AdaptConfig()
    registry = vocabulary(robot)
    with reader(ledger) as opened:
        curated = curate(opened, registry, dials.curation)
    dataset = dataset_of(curated, registry, dials.curation)
    if export and not dry_run:
        write_dataset(dataset, export)
    if json:
        tell({"card": dataset.card, "left_out": curated.left_out, "samples": _briefly(curated)})
    else:
        _say(dataset.card, curated)
    return Exit.SUCCESS


def _briefly(curated: Any) -> list[dict[str, Any]]:
    parts = (("train", curated.train), ("held_out", curated.held_out))
    fields = ("id", "memory", "events", "weight", "Delta", "duration", "repeats", "scene", "source", "contract")
    return [{"part": part, **{name: getattr(row, name) for name in fields}} for part, rows in parts for row in rows]


def _say(card: Any, curated: Any) -> None:
    told = Account()
    table = Table("id", "part", "memory", "events", "Δ", "w", "shown", "contract", box=None, pad_edge=False)
    for row in _briefly(curated):
        numbers = (f"{row['Delta']:.4f}", f"{row['weight']:.2f}", f"{row['repeats']}×")
        steps = row["contract"].partition('"action_sequence":')[2].removesuffix("}")
        events = " ".join(str(event) for event in row["events"])
        table.add_row(row["id"][:8], row["part"], row["memory"], events, *numbers, steps[:60])
    told.print(table)
    for reason, count in card.left_out.items():
        told.print(f"left out: {count} {reason}")
    told.print(
        f"data set {card.hash[:16]}: {card.train} samples to train on ({card.shown} shown an epoch), {card.held_out} "
        f"held out, {card.scenes} scenes; {card.merged} near-duplicates merged, of {card.memories} memories up to "
        f"event {card.event}"
    )
