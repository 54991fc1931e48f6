"""Markdown page of an evaluation, with its charts and images as files in the same folder."""

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
CHARTS_TITLE = "Charts and images"
FAILURE_IMAGE_PATTERN = re.compile(r"\((failure_[0-9]+\.jpg)\)")
MARKDOWN_SPECIAL_CHARACTERS = re.compile(r"([\\`*_{}\[\]<>#|!&])")


def write_markdown_page(folder: Path, data: ReportData) -> None:
    """Write report.md with its charts and images into `folder`.

    Images of an earlier page that the new page does not show are deleted, unless the new page has no images at all.
    """
    folder.mkdir(parents=True, exist_ok=True)
    replaced = _failure_images(folder / PAGE_FILE) if data.gallery else set[str]()
    lines = [f"## {CHARTS_TITLE}", ""]
    charts = [("curves", "Metrics over repetitions: mean with 95 % interval", data.curves)]
    charts += [("traces", f"Traces of one case: {traces_caption(data)}", data.traces)] if data.traced_pair else []
    charts += [("latencies", f"Latency: {LATENCY_NOTE}", data.latencies)]
    for name, title, chart in charts:
        folder.joinpath(f"{name}.svg").write_text(standalone_svg(chart), encoding="utf-8")
        lines += [f"{escape_markdown(title)}", "", f"![{name}]({name}.svg)", ""]
    for number, shot in enumerate(data.gallery, start=1):
        name = f"failure_{number}.jpg"
        folder.joinpath(name).write_bytes(encode_jpeg(shot.rgb))
        lines += [f"![{number}]({name})", "", *_caption(shot), ""]
    lines += ["## Not measured", "", *(f"- {line}" for line in data.not_measured), ""]
    lines += [
        "## Provenance",
        "",
        *(f"- {name}: {escape_markdown(fact)}" for name, fact in provenance_facts(data).items()),
        "",
    ]
    whole = markdown_page(f"Evaluation {data.suite.name}", header_lines(data), data.tables)
    folder.joinpath(PAGE_FILE).write_text(whole + "\n" + "\n".join(lines), encoding="utf-8")
    for old in replaced - _failure_images(folder / PAGE_FILE):  # images of a larger gallery
        folder.joinpath(old).unlink(missing_ok=True)


def _failure_images(page: Path) -> set[str]:
    """File names of the failure images that the page shows; empty if there is no page."""
    return (
        set(FAILURE_IMAGE_PATTERN.findall(page.read_text(encoding="utf-8", errors="replace")))
        if page.is_file()
        else set()
    )


def header_lines(data: ReportData) -> list[str]:
    """Description of the suite, number of episodes, date, code, seeds, and the command that reproduces the run."""
    seeds = sorted({row.seed for row in data.rows})
    code = data.config.get("origin", {}).get("code", "unknown")
    return [
        data.suite.description,
        f"{len(data.rows)} episodes, {data.date}, code {code}, seeds {seeds[0]} to {seeds[-1]} ({len(seeds)}).",
        f"Reproduce: `{data.command}`; with `--again KEY` a single episode by its key.",
    ]


def standalone_svg(chart: Html) -> str:
    """A chart of a page as an SVG file of its own, with the page's colours and background."""
    background = '<rect width="100%" height="100%" fill="var(--card)"/>'
    start = chart.index(">") + 1
    return f"{chart[:start]}<style>{palette_css()}</style>{background}{chart[start:]}\n"


def escape_markdown(text: str) -> str:
    """Untrusted text with every Markdown character escaped, on one line."""
    return MARKDOWN_SPECIAL_CHARACTERS.sub(r"\\\1", " ".join(text.split()))


def _caption(shot: FailureImage) -> list[str]:
    return [
        f"{escape_markdown(shot.row.method)}: {escape_markdown(headline(shot.row))}. {escape_markdown(shot.caption)}  ",
        f"`{shot.row.key}`",
    ]
