"""An evaluation as a Markdown page with its pictures beside it: what a repository can show."""

from __future__ import annotations

import re
from pathlib import Path

from dualbrain.evaluation.report.captions import headline
from dualbrain.evaluation.report.tables import markdown_page
from dualbrain.visualization.evaluation.html_report import (
    LATENCY_NOTE,
    FailureImage,
    ReportData,
    encode_jpeg,
    provenance_facts,
    traces_caption,
)
from dualbrain.visualization.html.page import Html, palette_css

PAGE_FILE = "report.md"
FAILURE_IMAGE_PATTERN = re.compile(r"\((failure_[0-9]+\.jpg)\)")
MARKDOWN_SPECIAL_CHARACTERS = re.compile(r"([\\`*_{}\[\]<>#|!&])")


def write_markdown_page(folder: Path, data: ReportData) -> None:
    """Write report.md, and what it shows, into `folder`."""
    folder.mkdir(parents=True, exist_ok=True)
    replaced = _failure_images(folder / PAGE_FILE) if data.gallery else set[str]()
    lines = ["## Pictures", ""]
    charts = [("curves", "Over repetitions: mean with its 95 % interval", data.curves)]
    charts += [("traces", f"One place: {traces_caption(data)}", data.traces)] if data.traced_pair else []
    charts += [("latencies", f"Latency: {LATENCY_NOTE}", data.latencies)]
    for name, title, chart in charts:
        folder.joinpath(f"{name}.svg").write_text(standalone_svg(chart), encoding="utf-8")
        lines += [f"{escape_markdown(title)}", "", f"![{name}]({name}.svg)", ""]
    for number, shot in enumerate(data.gallery, start=1):
        name = f"failure_{number}.jpg"
        folder.joinpath(name).write_bytes(encode_jpeg(shot.rgb))
        lines += [f"![{number}]({name})", "", *_caption(shot), ""]
    lines += ["## What was not measured", "", *(f"- {line}" for line in data.not_measured), ""]
    lines += [
        "## Where this comes from",
        "",
        *(f"- {name}: {escape_markdown(fact)}" for name, fact in provenance_facts(data).items()),
        "",
    ]
    whole = markdown_page(f"Evaluation {data.suite.name}", header_lines(data), data.tables)
    folder.joinpath(PAGE_FILE).write_text(whole + "\n" + "\n".join(lines), encoding="utf-8")
    for old in replaced - _failure_images(folder / PAGE_FILE):  # of a larger gallery
        folder.joinpath(old).unlink(missing_ok=True)


def _failure_images(page: Path) -> set[str]:
    """The pictures of failures that a page shows; none where there is no page yet."""
    return (
        set(FAILURE_IMAGE_PATTERN.findall(page.read_text(encoding="utf-8", errors="replace")))
        if page.is_file()
        else set()
    )


def header_lines(data: ReportData) -> list[str]:
    """What was flown, when, with which code and seeds, and how to fly it again."""
    seeds = sorted({row.seed for row in data.rows})
    code = data.config.get("origin", {}).get("code", "unknown")
    return [
        data.suite.description,
        f"{len(data.rows)} episodes, {data.date}, code {code}, seeds {seeds[0]} to {seeds[-1]} ({len(seeds)}).",
        f"Again: `{data.command}`; with `--again KEY` one episode by its key.",
    ]


def standalone_svg(chart: Html) -> str:
    """A chart of our pages as a file of its own: with the page's colours in it, on the page's ground."""
    ground = '<rect width="100%" height="100%" fill="var(--card)"/>'
    start = chart.index(">") + 1
    return f"{chart[:start]}<style>{palette_css()}</style>{ground}{chart[start:]}\n"


def escape_markdown(text: str) -> str:
    """Text of anybody, as Markdown that shows it and does nothing else."""
    return MARKDOWN_SPECIAL_CHARACTERS.sub(r"\\\1", " ".join(text.split()))


def _caption(shot: FailureImage) -> list[str]:
    return [
        f"{escape_markdown(shot.row.method)}: {escape_markdown(headline(shot.row))}. {escape_markdown(shot.caption)}  ",
        f"`{shot.row.key}`",
    ]
