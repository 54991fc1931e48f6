"""dualbrain report and compare: results of evaluations as an HTML file, as a Markdown page and as tables."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import msgspec
from cyclopts import Parameter
from rich.markup import escape

from dualbrain.cli.common.console import StderrConsole, print_result
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.spinner import Spinner
from dualbrain.cli.evaluation.results import (
    RUN_DATE_KEY,
    last_run_date,
    load_results,
    print_omission,
    reproduction_command,
)
from dualbrain.core.text import count_noun
from dualbrain.errors import ConfigurationError, UsageError

if TYPE_CHECKING:
    from dualbrain.evaluation.protocol.suite import Suite
    from dualbrain.evaluation.report.run_comparison import MetricChange
    from dualbrain.evaluation.report.tables import Table
    from dualbrain.evaluation.results.episode_row import EpisodeRow
    from dualbrain.visualization.evaluation.html_report import FailureImage

Flag = Annotated[bool, Parameter(negative="")]


def report(folder: Path, /, *, gallery: int = -1, page: Path | None = None, json: Flag = False) -> int:
    """Write the report of an evaluation as one HTML file and as a Markdown page.

    Parameters
    ----------
    folder
        Folder of the results: the --out of `dualbrain evaluate`.
    gallery
        Number of failures that are run again for an image; default as in the suite, 0 for none.
    page
        Folder of the Markdown page and its images; default FOLDER/page. If it is given, it also receives the table of
        all episodes without traces, from which the results can be compared, reported and run again.
    json
        Print the verdicts as one JSON object on stdout.
    """
    from dualbrain.cli.common.graphics import choose_graphics

    no_rendering = choose_graphics(os.environ)
    from dualbrain.evaluation.planners.answer_cache import AnswerCache
    from dualbrain.evaluation.results.parquet import RESULTS_FILE, without_trace, write_results
    from dualbrain.evaluation.runner.worker import ANSWERS_FOLDER
    from dualbrain.visualization.evaluation.html_report import ReportData, write_html_report
    from dualbrain.visualization.evaluation.markdown_page import PAGE_FILE, write_markdown_page

    page_folder, console, omissions = page or folder / "page", StderrConsole(), list[str]()
    if page_folder.exists() and not page_folder.is_dir():
        raise UsageError.stating(f"--page must be a folder, but {page_folder} is a file.")
    with Spinner(console, f"reading {folder}"):
        rows, config, suite = load_results(folder, omissions.append)
    count = suite.gallery if gallery < 0 else gallery
    images = [] if no_rendering or not count else _failure_images(rows, suite, count, console)
    if no_rendering and count:
        console.print(f"no images of failures: {no_rendering}", markup=False)
    answers = AnswerCache(folder / ANSWERS_FOLDER).read_all(omissions.append)
    if not answers:
        omissions.append(f"Decision times of single requests: the folder contains no answer cache ({ANSWERS_FOLDER}/).")
    data = ReportData(
        rows=rows,
        suite=suite,
        config=config,
        cached_answers=answers,
        gallery=images,
        date=last_run_date(folder, config),
        command=reproduction_command(suite, folder),
        omissions=omissions,
    )
    with Spinner(console, "writing the report"):
        write_html_report(folder / "report.html", data)
        write_markdown_page(page_folder, data)
    if page is not None and page.resolve() != folder.resolve():
        write_results(list(map(without_trace, rows)), config | {RUN_DATE_KEY: data.date}, page / RESULTS_FILE)
    for line in omissions:
        print_omission(line)
    for one in data.hypotheses:
        console.print(f"{one.name}: {one.verdict} ({one.description})", markup=False)
    console.print(f"report: {folder / 'report.html'}, and as a Markdown page: {page_folder / PAGE_FILE}", markup=False)
    if json:
        verdicts = [{"name": one.name, "verdict": one.verdict, "claims": one.claims} for one in data.hypotheses]
        print_result(msgspec.json.encode(verdicts).decode())
    return ExitCode.SUCCESS


def compare(first: Path, second: Path, /, *, all: Flag = False, json: Flag = False) -> int:
    """Compare two evaluations: the changes whose direction is known, and the differences of their configurations.

    Parameters
    ----------
    first
        Folder of results before the change: the --out of `dualbrain evaluate`.
    second
        Folder of results after the change.
    all
        Also print the changes that are identical, not clear or not known.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.evaluation.report.run_comparison import compute_changes, config_differences_table

    omissions = list[str]()
    with Spinner(StderrConsole(), "comparing"):
        before, after = load_results(first, omissions.append), load_results(second, omissions.append)
        changes = compute_changes(before[0], after[0])
    for line in omissions:
        print_omission(line)
    if not changes:
        raise ConfigurationError.stating(
            f"The evaluations {first} and {second} have no episode in common.",
            fix="Compare evaluations with common methods, scenes and repetitions.",
        )
    differences = config_differences_table(before[1], after[1])
    if json:
        encoded = [_encode_change(one) for one in changes]
        configuration = {entry: {"before": a, "after": b} for entry, a, b in differences.rows}
        print_result(msgspec.json.encode({"configuration": configuration, "changes": encoded}).decode())
    else:
        print_result("\n".join(_comparison_lines(changes, differences, all=all)))
    return ExitCode.SUCCESS


def _comparison_lines(changes: list[MetricChange], differences: Table, *, all: bool) -> list[str]:
    """What changed and is known, or that the evaluations are the same; with `all` every change."""
    from dualbrain.evaluation.report.run_comparison import changes_table, clear_changes, count_unclear_changes
    from dualbrain.evaluation.report.tables import markdown_table

    lines = markdown_table(differences) if differences.rows else ["The configurations are the same.", ""]
    if all:
        return [*lines, *markdown_table(changes_table(changes))]
    methods = len({one.method for one in changes})
    scope = f"{len(changes)} comparisons of {count_noun(methods, 'method')}"
    if {one.conclusion for one in changes} == {"identical"}:
        return [*lines, f"The results are the same: {scope} are identical."]
    clear, unclear = clear_changes(changes), count_unclear_changes(changes)
    lines += markdown_table(changes_table(clear)) if clear else ["No change has a known direction.", ""]
    return [*lines, f"Of {scope}, not shown: {unclear}; `--all` shows them."] if unclear else lines


def _encode_change(change: MetricChange) -> dict[str, Any]:
    """A change as a JSON object: numbers in the unit of the metric; infinite and unknown numbers become null."""
    found = change.comparison
    return {
        "method": change.method,
        "metric": change.metric.name,
        "unit": change.metric.unit,
        "change": found.effect,
        "low": found.low,
        "high": found.high,
        "p": change.p,
        "clusters": found.clusters,
        "word": change.conclusion,
    }


def _failure_images(rows: list[EpisodeRow], suite: Suite, count: int, console: StderrConsole) -> list[FailureImage]:
    """Images of up to `count` failures, chosen by `select_examples`."""
    from dualbrain.cli.evaluation.failure_images import capture_failure_image
    from dualbrain.evaluation.report.example_selection import select_examples

    images: list[FailureImage] = []
    for row in select_examples(rows, count):
        start = time.monotonic()
        with Spinner(console, f"running {row.key} again for its image"):
            images.append(capture_failure_image(row, suite, time.perf_counter))
        console.print(f"image of {escape(row.key)}  [dim]{time.monotonic() - start:.0f} s[/]")
    return images
