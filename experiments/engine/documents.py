"""The committed figures: docs/proofs.md between its markers; docs/learnable.md, docs/faults.md and the plots."""

from __future__ import annotations

import re
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from statistics import median

from experiments.engine.experiment import Experiment, Row
from experiments.engine.jsonl_log import JsonlLog
from experiments.engine.provenance import machine
from experiments.figures.plot_learning import plot_learning
from experiments.figures.plot_rounds import plot_rounds
from experiments.figures.plot_sensitivity import plot_sensitivity
from experiments.figures.plot_tick import plot_tick
from experiments.gatekeeper.fault_tables import fault_matrices
from experiments.planning.contract_sensitivity import scores_by_family
from experiments.planning.family_sweep import FAMILIES, SPEED

SENSITIVITY_PLOT_LINK = "![Δ by contract, family and seed](learnable.png)"
IMAGE_FOLDER = "images"
WILSON_INTERVALS = "Wilson, 95 %"
BEGIN_MARKER, END_MARKER = "<!-- figures: written by `make prove`, not by hand -->", "<!-- end of figures -->"


def write_documents(proofs: Iterable[Experiment], folder: Path, docs: Path) -> None:
    """Render every journal in `folder` that holds a row; pages must carry the markers.

    The section of a proof without a journal here stays as it stands: it was rendered where its journal was.
    """
    sections = _existing_sections(docs / "proofs.md")
    order: list[str] = []
    for proof in proofs:
        order.append(proof.name)
        rows = [row for row in JsonlLog(folder / f"{proof.name}.jsonl").rows() if "error" not in row]
        if not rows:
            continue
        section = [f"{proof.claim}", "", provenance_line(rows, _interval_note(proof)), "", *proof.report(rows)]
        if proof.name == "sweep":
            _replace_between_markers(docs / "learnable.md", [SENSITIVITY_PLOT_LINK, "", *section])
            plot_sensitivity(scores_by_family(rows), docs / "learnable.png")
            section = [
                proof.claim,
                "",
                provenance_line(rows),
                "",
                "Figures and plot: [learnable.md](learnable.md).",
                "",
            ]
        if proof.name == "faults":
            _replace_between_markers(docs / "faults.md", [provenance_line(rows), "", *fault_matrices(rows)])
        if proof.name == "tick":
            plot_tick(rows[-1], docs / IMAGE_FOLDER / "tick.png")
        if proof.name == "families":
            plot_sensitivity(scores_by_family(rows), docs / "families.png", SPEED, FAMILIES)
            section += ["", "![Δ by contract, family and seed](families.png)", ""]
        if proof.name == "learning":
            plot_learning(rows, docs / IMAGE_FOLDER / "learning.png")
        if proof.name == "rounds":
            plot_rounds(rows, docs / IMAGE_FOLDER / "rounds.png")
        sections[proof.name] = section
    names = sorted(sections, key=lambda name: order.index(name) if name in order else len(order))
    _replace_between_markers(
        docs / "proofs.md", [line for name in names for line in (f"## {name}", "", *sections[name], "")]
    )


def _existing_sections(page: Path) -> dict[str, list[str]]:
    """The sections between the markers of `page`, by name, in their order."""
    _, between, _ = _split_at_markers(page)
    _, *parts = re.split(r"^## (.+)$", between, flags=re.MULTILINE)
    return {name: text.strip("\n").split("\n") for name, text in zip(parts[::2], parts[1::2], strict=True)}


def _interval_note(proof: Experiment) -> str:
    """What its intervals are: what it says itself, else those of proportions (`figures.wilson`)."""
    return getattr(proof, "intervals", WILSON_INTERVALS)


def provenance_line(rows: list[Row], intervals: str = WILSON_INTERVALS) -> str:
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


def _replace_between_markers(page: Path, lines: list[str]) -> None:
    head, _, tail = _split_at_markers(page)
    page.write_text("\n".join([head + BEGIN_MARKER, "", *lines]).rstrip() + "\n\n" + END_MARKER + tail)


def _split_at_markers(page: Path) -> tuple[str, str, str]:
    """What stands before, between and after the markers of `page`."""
    head, rest = page.read_text().split(BEGIN_MARKER)
    between, tail = rest.split(END_MARKER)
    return head, between, tail
