"""Recompute the pages of committed results from their tables, with the current statistics and wording.

    python -m tools.results.refresh_pages [docs/results/paper ...]

A committed results.parquet contains neither traces nor the answers of the planners, and the images of failures are
expensive. The page keeps what depends on them: traces.svg, latencies.svg, the images and the table of decision times.
Everything else is computed again: all other tables, curves.svg, captions, texts.
"""

from __future__ import annotations

import html
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

from dualbrain.cli.evaluation.results import last_run_date, load_results, reproduction_command
from dualbrain.evaluation.report.adaptation_cost import costs_from_config
from dualbrain.evaluation.report.captions import caption
from dualbrain.evaluation.report.decision_latency import (
    DECISION_LATENCY_HEADER,
    DECISION_LATENCY_NOTE,
    DECISION_LATENCY_TITLE,
)
from dualbrain.evaluation.report.not_measured import NO_TRACES, list_not_measured
from dualbrain.evaluation.report.tables import THROUGHPUT_TITLE, Table
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.visualization.evaluation.html_report import ReportData
from dualbrain.visualization.evaluation.markdown_page import (
    PAGE_FILE,
    TRACES_PREFIX,
    render_markdown_page,
    standalone_svg,
)

RESULTS = Path(__file__).resolve().parents[2] / "docs" / "results"
IMAGE = re.compile(r"!\[\d+\]\(failure_\d+\.jpg\)\n\n(?P<caption>.*?)  \n`(?P<key>.*)`")
VIOLATION_TIME = re.compile(r", at \d+\.\d s \(")


def main() -> int:
    """Refresh the folders of the command line, or else all results."""
    folders = [Path(one) for one in sys.argv[1:]] or sorted(path.parent for path in RESULTS.rglob("results.parquet"))
    for folder in folders:
        data = report_data(folder)
        page = folder / PAGE_FILE
        page.write_text(refreshed_page(data, page.read_text(encoding="utf-8")), encoding="utf-8")
        folder.joinpath("curves.svg").write_text(standalone_svg(data.curves), encoding="utf-8")
        print(page)
    return 0


def report_data(folder: Path) -> ReportData:
    """Contents of a report of the results in `folder`."""
    rows, config, suite = load_results(folder)
    date, command = last_run_date(folder, config), reproduction_command(suite, folder)
    return ReportData(rows=rows, suite=suite, config=config, date=date, command=command)


def refreshed_page(data: ReportData, old: str) -> str:
    """Text of the page of `data`, with the parts of the `old` page that cannot be computed from the table."""
    latencies = decision_latencies(old)
    tables: list[Table] = []
    for table in data.tables:
        if table.title == THROUGHPUT_TITLE and latencies.rows:
            tables.append(latencies)
        tables.append(table)
    pair = re.search(rf"^{TRACES_PREFIX}(.*?); ", old, re.MULTILINE)
    traced_pair = unescaped(pair[1]) if pair else ""
    not_measured = list_not_measured(data.rows, data.suite, costs_from_config(data.config))
    not_measured = [line for line in not_measured if not (traced_pair and line == NO_TRACES)]
    return render_markdown_page(data, tables, not_measured, traced_pair, captions(data.rows, old))


def decision_latencies(page: str) -> Table:
    """Table of the decision times in `page`; without rows if the page has none."""
    lines = page.partition(f"## {DECISION_LATENCY_TITLE}\n")[2].partition("\n## ")[0].splitlines()
    rows = [tuple(map(unescaped, line.strip("| ").split(" | "))) for line in lines if line.startswith("|")][2:]
    return Table(DECISION_LATENCY_TITLE, DECISION_LATENCY_HEADER, tuple(rows), DECISION_LATENCY_NOTE)


def unescaped(text: str) -> str:
    """The text that `escape_markdown` made `text` from."""
    return html.unescape(re.sub(r"\\(.)", r"\1", text))


def captions(rows: Sequence[EpisodeRow], page: str) -> list[tuple[EpisodeRow, str]]:
    """Rows and captions of the images of failures in `page`, in their order."""
    by_key: Mapping[str, EpisodeRow] = {row.key: row for row in rows}
    found: list[tuple[EpisodeRow, str]] = []
    for image in IMAGE.finditer(page):
        row = by_key[image["key"]]
        worst = max(row.violations, key=lambda one: one.peak, default=None)
        found.append((row, caption(row, worst if VIOLATION_TIME.search(image["caption"]) else None)))
    return found


if __name__ == "__main__":
    raise SystemExit(main())
