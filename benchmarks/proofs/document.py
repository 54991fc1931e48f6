"""The committed figures: docs/proofs.md between its markers, docs/learnable.md with its plot."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from statistics import median

from proofs.journal import Journal
from proofs.learnable import families
from proofs.origin import machine
from proofs.plot import plot
from proofs.plot_learning import plot_learning
from proofs.proof import Proof, Row

PICTURE = "![Δ by contract, family and seed](learnable.png)"
BEGIN, END = "<!-- figures: written by `make prove`, not by hand -->", "<!-- end of figures -->"


def write_documents(proofs: Iterable[Proof], folder: Path, docs: Path) -> None:
    """Render every journal in `folder` that holds a row; pages must carry the markers."""
    sections: list[str] = []
    for proof in proofs:
        rows = [row for row in Journal(folder / f"{proof.name}.jsonl").rows() if "error" not in row]
        if not rows:
            continue
        section = [f"{proof.claim}", "", provenance(rows), "", *proof.report(rows)]
        if proof.name == "sweep":
            _between(docs / "learnable.md", [PICTURE, "", *section])
            plot(families(rows), docs / "learnable.png")
            section = [proof.claim, "", provenance(rows), "", "Figures and plot: [learnable.md](learnable.md).", ""]
        if proof.name == "learning":
            plot_learning(rows, docs / "learning.png")
        sections += [f"## {proof.name}", "", *section]
    _between(docs / "proofs.md", sections)


def provenance(rows: list[Row]) -> str:
    """Dates, revisions, machine, load and processor time of the rows."""
    dates, loads = sorted({row["date"] for row in rows}), [row["load"] for row in rows if "load" in row]
    revisions = ", ".join(f"{name} ({count})" for name, count in Counter(row["revision"] for row in rows).items())
    days = dates[0] if dates[0] == dates[-1] else f"{dates[0]} to {dates[-1]}"
    hours = sum(row.get("wall_s", 0.0) for row in rows) / 3600
    busy = f", median load {median(loads):.1f}" if loads else ""
    return (
        f"*{len(rows)} units, {days}; revision {revisions} (+: with uncommitted changes); {machine()}{busy}; "
        f"{hours:.1f} h of workers; intervals: Wilson, 95 %. Rendered {time.strftime('%Y-%m-%d', time.gmtime())}.*"
    )


def _between(page: Path, lines: list[str]) -> None:
    text = page.read_text()
    head, rest = text.split(BEGIN)
    tail = rest.split(END)[1]
    page.write_text("\n".join([head + BEGIN, "", *lines]).rstrip() + "\n\n" + END + tail)
