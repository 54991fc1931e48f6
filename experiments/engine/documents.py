"""The committed figures: docs/proofs.md between its markers; docs/learnable.md, docs/faults.md and the plots."""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from statistics import median

from experiments.engine.experiment import Proof, Row
from experiments.engine.jsonl_log import Journal
from experiments.engine.provenance import machine
from experiments.figures.plot_learning import plot_learning
from experiments.figures.plot_rounds import plot_rounds
from experiments.figures.plot_sensitivity import plot
from experiments.figures.plot_tick import plot_tick
from experiments.gatekeeper.fault_tables import matrices
from experiments.planning.contract_sensitivity import families
from experiments.planning.family_sweep import FAMILIES, SPEED

PICTURE = "![Δ by contract, family and seed](learnable.png)"
PICTURES = "images"
WILSON = "Wilson, 95 %"
BEGIN, END = "<!-- figures: written by `make prove`, not by hand -->", "<!-- end of figures -->"


def write_documents(proofs: Iterable[Proof], folder: Path, docs: Path) -> None:
    """Render every journal in `folder` that holds a row; pages must carry the markers.

    The section of a proof without a journal here stays as it stands: it was rendered where its journal was.
    """
    sections = _standing(docs / "proofs.md")
    order: list[str] = []
    for proof in proofs:
        order.append(proof.name)
        rows = [row for row in Journal(folder / f"{proof.name}.jsonl").rows() if "error" not in row]
        if not rows:
            continue
        section = [f"{proof.claim}", "", provenance(rows, _intervals(proof)), "", *proof.report(rows)]
        if proof.name == "sweep":
            _between(docs / "learnable.md", [PICTURE, "", *section])
            plot(families(rows), docs / "learnable.png")
            section = [proof.claim, "", provenance(rows), "", "Figures and plot: [learnable.md](learnable.md).", ""]
        if proof.name == "faults":
            _between(docs / "faults.md", [provenance(rows), "", *matrices(rows)])
        if proof.name == "tick":
            plot_tick(rows[-1], docs / PICTURES / "tick.png")
        if proof.name == "families":
            plot(families(rows), docs / "families.png", SPEED, FAMILIES)
            section += ["", "![Δ by contract, family and seed](families.png)", ""]
        if proof.name == "learning":
            plot_learning(rows, docs / PICTURES / "learning.png")
        if proof.name == "rounds":
            plot_rounds(rows, docs / PICTURES / "rounds.png")
        sections[proof.name] = section
    names = sorted(sections, key=lambda name: order.index(name) if name in order else len(order))
    _between(docs / "proofs.md", [line for name in names for line in (f"## {name}", "", *sections[name], "")])


def _standing(page: Path) -> dict[str, list[str]]:
    """The sections between the markers of `page`, by name, in their order."""
    _, between, _ = _parted(page)
    _, *parts = re.split(r"^## (.+)$", between, flags=re.MULTILINE)
    return {name: text.strip("\n").split("\n") for name, text in zip(parts[::2], parts[1::2], strict=True)}


def _intervals(proof: Proof) -> str:
    """What its intervals are: what it says itself, else those of proportions (`figures.wilson`)."""
    return getattr(proof, "intervals", WILSON)


def provenance(rows: list[Row], intervals: str = WILSON) -> str:
    """Dates, revisions, machine, load and processor time of the rows; what their intervals are."""
    dates, loads = sorted({row["date"] for row in rows}), [row["load"] for row in rows if "load" in row]
    revisions = ", ".join(f"{name} ({count})" for name, count in Counter(row["revision"] for row in rows).items())
    days = dates[0] if dates[0] == dates[-1] else f"{dates[0]} to {dates[-1]}"
    hours = sum(row.get("wall_s", 0.0) for row in rows) / 3600
    busy = f", median load {median(loads):.1f}" if loads else ""
    return (
        f"*{len(rows)} units, {days}; revision {revisions} (+: with uncommitted changes); {machine()}{busy}; "
        f"{hours:.1f} h of workers; intervals: {intervals}. Rendered {time.strftime('%Y-%m-%d', time.gmtime())}.*"
    )


def _between(page: Path, lines: list[str]) -> None:
    head, _, tail = _parted(page)
    page.write_text("\n".join([head + BEGIN, "", *lines]).rstrip() + "\n\n" + END + tail)


def _parted(page: Path) -> tuple[str, str, str]:
    """What stands before, between and after the markers of `page`."""
    head, rest = page.read_text().split(BEGIN)
    between, tail = rest.split(END)
    return head, between, tail
