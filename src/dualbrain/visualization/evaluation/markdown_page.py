"""Markdown page of an evaluation, with its charts and images as files in the same folder."""

from __future__ import annotations

import re
from collections.abc import Sequence
from pathlib import Path

from dualbrain.core.markdown import code_span, escape_markdown
from dualbrain.core.untrusted.visible_text import visible_text
from dualbrain.evaluation.report.captions import headline
from dualbrain.evaluation.report.summary import describe_methods
from dualbrain.evaluation.report.tables import Table, markdown_page
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.visualization.evaluation.html_report import (
    CURVES_NOTE,
    LATENCY_NOTE,
    ReportData,
    encode_jpeg,
    provenance_facts,
    traces_caption,
)
from dualbrain.visualization.html.page import Html, palette_css

PAGE_FILE = "report.md"
CHARTS_TITLE, TRACES_PREFIX = "Charts and images", "Traces of one case: "
FAILURE_IMAGE_PATTERN = re.compile(r"\((failure_[0-9]+\.jpg)\)")


def write_markdown_page(folder: Path, data: ReportData) -> None:
    """Write report.md with its charts and images into `folder`.

    Images of an earlier page that the new page does not show are deleted, unless the new page has no images at all.
    """
    folder.mkdir(parents=True, exist_ok=True)
    replaced = _failure_images(folder / PAGE_FILE) if data.gallery else set[str]()
    charts = [("summary", data.bars), ("curves", data.curves), ("latencies", data.latencies)]
    charts += [("traces", data.traces)] if data.traced_pair else []
    for name, chart in charts:
        folder.joinpath(f"{name}.svg").write_text(standalone_svg(chart), encoding="utf-8")
    for number, image in enumerate(data.gallery, start=1):
        folder.joinpath(f"failure_{number}.jpg").write_bytes(encode_jpeg(image.rgb))
    captions = [(image.row, image.caption) for image in data.gallery]
    text = render_markdown_page(data, data.tables, data.not_measured, data.traced_pair, captions)
    folder.joinpath(PAGE_FILE).write_text(text, encoding="utf-8")
    for old in replaced - _failure_images(folder / PAGE_FILE):  # images of a larger gallery
        folder.joinpath(old).unlink(missing_ok=True)


def render_markdown_page(
    data: ReportData,
    tables: Sequence[Table],
    not_measured: Sequence[str],
    traced_pair: str,
    captions: Sequence[tuple[EpisodeRow, str]],
) -> str:
    """Text of the page.

    `traced_pair` is the case of the traces ("" without traces), `captions` are those of failure_1.jpg, failure_2.jpg, …
    """
    titles = {"curves": f"Metrics over repetitions: {CURVES_NOTE}"}
    titles |= {"traces": f"{TRACES_PREFIX}{traces_caption(traced_pair)}"} if traced_pair else {}
    titles |= {"latencies": f"Latency: {LATENCY_NOTE}"}
    lines = [f"## {CHARTS_TITLE}", ""]
    for name, title in titles.items():
        lines += [escape_markdown(title), "", f"![{name}]({name}.svg)", ""]
    for number, (row, caption) in enumerate(captions, start=1):
        lines += [f"![{number}](failure_{number}.jpg)", "", *_caption_lines(row, caption), ""]
    lines += ["## Not measured", "", *(f"- {escape_markdown(line)}" for line in not_measured), ""]
    facts = provenance_facts(data)
    lines += ["## Provenance", "", *(f"- {name}: {escape_markdown(fact)}" for name, fact in facts.items()), ""]
    return markdown_page(f"Evaluation {data.suite.name}", header_lines(data), tables) + "\n" + "\n".join(lines)


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
        f"**{escape_markdown(data.summary)}**",
        "![success and violations by method](summary.svg)",
        escape_markdown(describe_methods(data.rows)),
        escape_markdown(data.suite.description),
        escape_markdown(
            f"{len(data.rows)} episodes, {data.date}, code {code}, seeds {seeds[0]} to {seeds[-1]} ({len(seeds)})."
        ),
        f"Reproduce: {code_span(data.command)}; with `--again KEY` a single episode by its key.",
    ]


def standalone_svg(chart: Html) -> str:
    """A chart of a page as an SVG file of its own, with the page's colours and background."""
    background = '<rect width="100%" height="100%" fill="var(--card)"/>'
    start = chart.index(">") + 1
    svg = f"{chart[:start]}<style>{palette_css()}</style>{background}{chart[start:]}\n"
    return visible_text(svg, keep_lines=True)


def _caption_lines(row: EpisodeRow, caption: str) -> list[str]:
    return [
        f"{escape_markdown(row.method)}: {escape_markdown(headline(row))}. {escape_markdown(caption)}  ",
        code_span(row.key),
    ]
