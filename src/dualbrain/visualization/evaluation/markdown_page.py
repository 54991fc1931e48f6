"""An evaluation as a Markdown page with its pictures beside it: what a repository can show."""

from __future__ import annotations

import re
from pathlib import Path

from dualbrain.evaluation.report.captions import headline
from dualbrain.evaluation.report.tables import page
from dualbrain.visualization.evaluation.html_report import LATENCY, Shot, Told, facts, jpeg, traces_words
from dualbrain.visualization.html.page import Html, palette

PAGE = "report.md"
FAILURE = re.compile(r"\((failure_[0-9]+\.jpg)\)")
SPECIAL = re.compile(r"([\\`*_{}\[\]<>#|!&])")


def write_page(folder: Path, told: Told) -> None:
    """Write report.md, and what it shows, into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    replaced = _shown(folder / PAGE) if told.gallery else set[str]()
    lines = ["## Pictures", ""]
    charts = [("curves", "Over repetitions: mean with its 95 % interval", told.curves)]
    charts += [("traces", f"One place: {traces_words(told)}", told.traces)] if told.traced else []
    charts += [("latencies", f"Latency: {LATENCY}", told.latencies)]
    for name, title, chart in charts:
        folder.joinpath(f"{name}.svg").write_text(standing(chart), encoding="utf-8")
        lines += [f"{literal(title)}", "", f"![{name}]({name}.svg)", ""]
    for number, shot in enumerate(told.gallery, start=1):
        name = f"failure_{number}.jpg"
        folder.joinpath(name).write_bytes(jpeg(shot.rgb))
        lines += [f"![{number}]({name})", "", *_caption(shot), ""]
    lines += ["## What was not measured", "", *(f"- {line}" for line in told.missing), ""]
    lines += ["## Where this comes from", "", *(f"- {name}: {literal(fact)}" for name, fact in facts(told).items()), ""]
    whole = page(f"Evaluation {told.suite.name}", about(told), told.grids)
    folder.joinpath(PAGE).write_text(whole + "\n" + "\n".join(lines), encoding="utf-8")
    for old in replaced - _shown(folder / PAGE):  # of a larger gallery
        folder.joinpath(old).unlink(missing_ok=True)


def _shown(page: Path) -> set[str]:
    """The pictures of failures that a page shows; none where there is no page yet."""
    return set(FAILURE.findall(page.read_text(encoding="utf-8", errors="replace"))) if page.is_file() else set()


def about(told: Told) -> list[str]:
    """What was flown, when, with which code and seeds, and how to fly it again."""
    seeds = sorted({row.seed for row in told.rows})
    code = told.config.get("origin", {}).get("code", "unknown")
    return [
        told.suite.says,
        f"{len(told.rows)} episodes, {told.date}, code {code}, seeds {seeds[0]} to {seeds[-1]} ({len(seeds)}).",
        f"Again: `{told.command}`; with `--again KEY` one episode by its key.",
    ]


def standing(chart: Html) -> str:
    """A chart of our pages as a file of its own: with the page's colours in it, on the page's ground."""
    ground = '<rect width="100%" height="100%" fill="var(--card)"/>'
    start = chart.index(">") + 1
    return f"{chart[:start]}<style>{palette()}</style>{ground}{chart[start:]}\n"


def literal(text: str) -> str:
    """Text of anybody, as Markdown that shows it and does nothing else."""
    return SPECIAL.sub(r"\\\1", " ".join(text.split()))


def _caption(shot: Shot) -> list[str]:
    return [
        f"{literal(shot.row.method)}: {literal(headline(shot.row))}. {literal(shot.caption)}  ",
        f"`{shot.row.key}`",
    ]
