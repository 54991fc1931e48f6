"""Pages of the experiments: docs/experiments/<group>/<name>.md, the plots in docs/images, and the list of all pages.

Text above the marker line of a page (title, method, how to read the tables) is written by hand and stays. Everything
below it is rendered from the log: claim, provenance, plot, tables.
"""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Callable, Iterable
from pathlib import Path
from statistics import median

from dualbrain.core.storage.jsonl_log import JsonlLog
from experiments.engine.experiment import Experiment, Row, group_of
from experiments.figures.plot_learning import plot_learning
from experiments.figures.plot_rounds import plot_rounds
from experiments.figures.plot_sensitivity import plot_sensitivity
from experiments.figures.plot_tick import plot_tick
from experiments.planning.contract_sensitivity import scores_by_family
from experiments.planning.family_sweep import FAMILIES, SPEED

MARKER = "<!-- Everything below this line is written by `python -m experiments --write-docs`. -->"
INDEX_MARKER = "<!-- The table below is written by `python -m experiments --write-docs`. -->"
INDEX_FILE = "README.md"
WILSON_INTERVALS = "Wilson, 95 %"
UNKNOWN_MACHINE = "not recorded"


def _draw_sensitivity(rows: list[Row], path: Path) -> None:
    plot_sensitivity(scores_by_family(rows), path)


def _draw_families(rows: list[Row], path: Path) -> None:
    plot_sensitivity(scores_by_family(rows), path, SPEED, FAMILIES)


def _draw_tick(rows: list[Row], path: Path) -> None:
    plot_tick([row for row in rows if row["variant"] == "loop"][-1], path)


PLOTS: dict[str, tuple[str, Callable[[list[Row], Path], None]]] = {
    "sensitivity_sweep": ("Δ by contract, family and seed", _draw_sensitivity),
    "family_sweep": ("Δ by contract, family and seed", _draw_families),
    "tick": ("Intervals between joint states, and the parts of a tick", _draw_tick),
    "learning": ("Δ, decision time and weights over repetitions", plot_learning),
    "rounds": ("Measures by round", plot_rounds),
}
"""By experiment: the caption of its plot, and the function that draws the plot."""


def write_pages(experiments: Iterable[Experiment], folder: Path, docs: Path) -> None:
    """Render the page of each experiment whose log in `folder` has a finished unit; other pages stay as they are.

    Raises `ValueError` for a page without its marker line.
    """
    for experiment in experiments:
        rows = [row for row in JsonlLog(folder / f"{experiment.name}.jsonl").latest() if "error" not in row]
        if rows:
            write_page(experiment, rows, docs)


def write_page(experiment: Experiment, rows: list[Row], docs: Path) -> None:
    """Render everything below the marker line of an experiment's page; a new page gets the name as its title."""
    page = page_path(experiment, docs)
    text = page.read_text("utf-8") if page.exists() else f"{default_title(experiment)}\n\n{MARKER}\n"
    head, old = _split(text, MARKER, page)
    lines = [MARKER, "", f"**Claim.** {experiment.claim}", ""]
    lines += [*provenance_table(rows, _intervals(experiment), _former_machine(old)), "", "## Results", ""]
    if experiment.name in PLOTS:
        caption, draw = PLOTS[experiment.name]
        image = docs / "images" / f"{experiment.name}.png"
        image.parent.mkdir(parents=True, exist_ok=True)
        draw(rows, image)
        lines += [f"![{caption}](../../images/{image.name})", ""]
    lines += experiment.report(rows)
    page.parent.mkdir(parents=True, exist_ok=True)
    page.write_text(head + _join(lines), "utf-8")


def write_index(experiments: Iterable[Experiment], docs: Path) -> None:
    """Render the table of all pages below the marker line of docs/experiments/README.md."""
    index = docs / "experiments" / INDEX_FILE
    head, _ = _split(index.read_text("utf-8"), INDEX_MARKER, index)
    lines = [INDEX_MARKER, "", "| experiment | claim |", "| --- | --- |"]
    for experiment in experiments:
        if page_path(experiment, docs).exists():
            link = f"[`{experiment.name}`]({group_of(experiment)}/{experiment.name}.md)"
            lines.append(f"| {link} | {experiment.claim} |")
    index.write_text(head + _join(lines), "utf-8")


def page_path(experiment: Experiment, docs: Path) -> Path:
    """The page of an experiment."""
    return docs / "experiments" / group_of(experiment) / f"{experiment.name}.md"


def default_title(experiment: Experiment) -> str:
    """The first line of a page that has not been written by hand yet."""
    return f"# {experiment.name.replace('_', ' ').capitalize()}"


def provenance_table(rows: list[Row], intervals: str = WILSON_INTERVALS, machine: str = UNKNOWN_MACHINE) -> list[str]:
    """Dates, units, revisions, machine, load and worker time of the rows, and the kind of intervals in the tables.

    `machine` is used for rows that do not name theirs.
    """
    dates, loads = sorted({row["date"] for row in rows}), [row["load"] for row in rows if "load" in row]
    revisions = Counter(row["revision"] for row in rows)
    machines = dict.fromkeys(row.get("machine", machine) for row in rows)
    facts = {
        "date": dates[0] if dates[0] == dates[-1] else f"{dates[0]} to {dates[-1]}",
        "units": f"{len(rows)}",
        "revision": ", ".join(f"{name} ({count})" for name, count in revisions.items()),
        "machine": "; ".join(machines),
        "worker time": f"{sum(row.get('wall_s', 0.0) for row in rows) / 3600:.1f} h",
        "intervals": intervals,
    }
    if any("+" in name for name in revisions):
        facts["revision"] += " (+: with uncommitted changes)"
    if loads:
        facts["worker time"] += f", median load {median(loads):.1f}"
    return ["| | |", "| --- | --- |", *(f"| {name} | {value} |" for name, value in facts.items())]


def _intervals(experiment: Experiment) -> str:
    """The kind of intervals in an experiment's tables."""
    return getattr(experiment, "intervals", WILSON_INTERVALS)


def _former_machine(rendered: str) -> str:
    """The machine that a page names: rows of older logs do not."""
    found = re.search(r"^\| machine \| (.*) \|$", rendered, re.MULTILINE)
    return found[1] if found else UNKNOWN_MACHINE


def _split(text: str, marker: str, page: Path) -> tuple[str, str]:
    """The text of `page` before and after its only marker line."""
    if text.count(marker) != 1:
        raise ValueError(f"{page} must contain this line exactly once: {marker}")
    head, _, tail = text.partition(marker)
    return head, tail


def _join(lines: list[str]) -> str:
    """`lines` as text, without repeated blank lines."""
    return re.sub(r"\n{3,}", "\n\n", "\n".join(lines)).rstrip() + "\n"
