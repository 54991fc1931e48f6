"""dualbrain report and compare: what an evaluation found, as one HTML file and as tables."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Annotated, Any

import msgspec
from cyclopts import Parameter

from dualbrain.cli.common.console import StderrConsole, print_result
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.evaluation.results import (
    RUN_DATE_KEY,
    last_run_date,
    load_results,
    print_omission,
    reproduction_command,
)
from dualbrain.errors import ConfigurationError, UsageError

Flag = Annotated[bool, Parameter(negative="")]


def report(folder: Path, /, *, gallery: int = -1, page: Path | None = None, json: Flag = False) -> int:
    """What an evaluation found, as one HTML file.

    Parameters
    ----------
    folder
        What `dualbrain evaluate --out` names.
    gallery
        How many failures are flown again for a picture; default as the suite says, 0 for none.
    page
        Where the Markdown page and its pictures go; default FOLDER/page. A place that is named gets the table of all
        episodes, too, without traces: what can be compared, reported and flown again.
    json
        Print one JSON object on stdout: the verdicts.
    """
    from dualbrain.cli.common.graphics import choose_graphics

    blind = choose_graphics(os.environ)
    from dualbrain.evaluation.planners.answer_cache import AnswerCache
    from dualbrain.evaluation.results.parquet import RESULTS_FILE, without_trace, write_results
    from dualbrain.evaluation.runner.worker import ANSWERS_FOLDER
    from dualbrain.visualization.evaluation.html_report import ReportData, write_html_report
    from dualbrain.visualization.evaluation.markdown_page import PAGE_FILE, write_markdown_page

    pages, account, left_out = page or folder / "page", StderrConsole(), list[str]()
    if pages.exists() and not pages.is_dir():
        raise UsageError("--page", got=str(pages), allowed="a folder, there or to be made")
    rows, config, suite = load_results(folder, left_out.append)
    count = suite.gallery if gallery < 0 else gallery
    shots = [] if blind or not count else _failure_images(rows, suite, count, account)
    if blind and count:
        account.print(f"no pictures: {blind}")
    kept = AnswerCache(folder / ANSWERS_FOLDER).read_all(left_out.append)
    if not kept:
        left_out.append(f"How long each decision took: the answers to questions ({ANSWERS_FOLDER}/) are not kept here.")
    told = ReportData(
        rows=rows,
        suite=suite,
        config=config,
        cached_answers=kept,
        gallery=shots,
        date=last_run_date(folder, config),
        command=reproduction_command(suite, folder),
        omissions=left_out,
    )
    write_html_report(folder / "report.html", told)
    write_markdown_page(pages, told)
    if page is not None and page.resolve() != folder.resolve():
        write_results(list(map(without_trace, rows)), config | {RUN_DATE_KEY: told.date}, page / RESULTS_FILE)
    for line in left_out:
        print_omission(line)
    for one in told.hypotheses:
        account.print(f"{one.name}: {one.verdict} ({one.description})")
    account.print(f"report: {folder / 'report.html'}, and as a page with pictures: {pages / PAGE_FILE}")
    if json:
        told_json = [{"name": one.name, "verdict": one.verdict, "claims": one.claims} for one in told.hypotheses]
        print_result(msgspec.json.encode(told_json).decode())
    return ExitCode.SUCCESS


def compare(first: Path, second: Path, /, *, json: Flag = False) -> int:
    """What changed between two evaluations.

    Parameters
    ----------
    first
        What `dualbrain evaluate --out` names.
    second
        Another one.
    json
        Print one JSON object on stdout.
    """
    from dualbrain.evaluation.report.run_comparison import changes_table, compute_changes, config_differences_table
    from dualbrain.evaluation.report.tables import markdown_table

    before, after = load_results(first, print_omission), load_results(second, print_omission)
    grid = changes_table(before[0], after[0])
    if not grid.rows:
        got = f"no episode of {first} in {second}"
        raise ConfigurationError("evaluations to compare", got=got, allowed="common methods, scenes and repetitions")
    set_up = config_differences_table(before[1], after[1])
    if json:
        told = [_encode_change(one) for one in compute_changes(before[0], after[0])]
        differing = {what: {"before": a, "after": b} for what, a, b in set_up.rows}
        print_result(msgspec.json.encode({"configuration": differing, "changes": told}).decode())
    else:
        print_result("\n".join([*markdown_table(set_up), *markdown_table(grid)]))
    return ExitCode.SUCCESS


def _encode_change(change: Any) -> dict[str, Any]:
    """One change for a program: numbers in the metric's unit, what is infinite or not known is encoded as null."""
    found = change.found
    return {
        "method": change.method,
        "metric": change.metric.name,
        "unit": change.metric.unit,
        "change": found.effect,
        "low": found.low,
        "high": found.high,
        "p": change.p,
        "clusters": found.clusters,
        "word": change.word,
    }


def _failure_images(rows: list[Any], suite: Any, count: int, account: StderrConsole) -> list[Any]:
    """Pictures of failures, one class and method after the other."""
    from dualbrain.cli.evaluation.failure_images import capture_failure_image
    from dualbrain.evaluation.report.example_selection import select_examples

    shots: list[Any] = []
    for row in select_examples(rows, count):
        began = time.monotonic()
        shots.append(capture_failure_image(row, suite, time.perf_counter))
        account.print(f"picture of {row.key}  [dim]{time.monotonic() - began:.0f} s[/]")
    return shots
