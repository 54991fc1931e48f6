"""dualbrain report and compare: what an evaluation found, as one HTML file and as tables."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import Annotated, Any

import msgspec
from cyclopts import Parameter

from dualbrain.cli.common.console import Account, answer
from dualbrain.cli.common.exit_codes import Exit
from dualbrain.cli.evaluation.results import FLOWN, command_of, flown_on, results, tell_left_out
from dualbrain.errors import InvalidSetup, WrongUsage

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
    from dualbrain.evaluation.planners.answer_cache import Plans
    from dualbrain.evaluation.results.parquet import FILE, without_trace, write_table
    from dualbrain.evaluation.runner.worker import PLANS
    from dualbrain.visualization.evaluation.html_report import Told, write_evaluation
    from dualbrain.visualization.evaluation.markdown_page import PAGE, write_page

    pages, account, left_out = page or folder / "page", Account(), list[str]()
    if pages.exists() and not pages.is_dir():
        raise WrongUsage("--page", got=str(pages), allowed="a folder, there or to be made")
    rows, config, suite = results(folder, left_out.append)
    count = suite.gallery if gallery < 0 else gallery
    shots = [] if blind or not count else _shots(rows, suite, count, account)
    if blind and count:
        account.print(f"no pictures: {blind}")
    kept = Plans(folder / PLANS).all(left_out.append)
    if not kept:
        left_out.append(f"How long each decision took: the answers to questions ({PLANS}/) are not kept here.")
    told = Told(rows, suite, config, kept, shots, flown_on(folder, config), command_of(suite, folder), left_out)
    write_evaluation(folder / "report.html", told)
    write_page(pages, told)
    if page is not None and page.resolve() != folder.resolve():
        write_table(list(map(without_trace, rows)), config | {FLOWN: told.date}, page / FILE)
    for line in left_out:
        tell_left_out(line)
    for one in told.found:
        account.print(f"{one.name}: {one.verdict} ({one.says})")
    account.print(f"report: {folder / 'report.html'}, and as a page with pictures: {pages / PAGE}")
    if json:
        told_json = [{"name": one.name, "verdict": one.verdict, "claims": one.claims} for one in told.found]
        answer(msgspec.json.encode(told_json).decode())
    return Exit.SUCCESS


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
    from dualbrain.evaluation.report.run_comparison import changed, changes, otherwise
    from dualbrain.evaluation.report.tables import grid_lines

    before, after = results(first, tell_left_out), results(second, tell_left_out)
    grid = changes(before[0], after[0])
    if not grid.rows:
        got = f"no episode of {first} in {second}"
        raise InvalidSetup("evaluations to compare", got=got, allowed="common methods, scenes and repetitions")
    set_up = otherwise(before[1], after[1])
    if json:
        told = [_as_numbers(one) for one in changed(before[0], after[0])]
        differing = {what: {"before": a, "after": b} for what, a, b in set_up.rows}
        answer(msgspec.json.encode({"configuration": differing, "changes": told}).decode())
    else:
        answer("\n".join([*grid_lines(set_up), *grid_lines(grid)]))
    return Exit.SUCCESS


def _as_numbers(change: Any) -> dict[str, Any]:
    """One change for a program: numbers in the metric's unit, what is infinite or not known is encoded as null."""
    found = change.found
    return {
        "method": change.method, "metric": change.metric.name, "unit": change.metric.unit, "change": found.effect,
        "low": found.low, "high": found.high, "p": change.p, "clusters": found.clusters, "word": change.word,
    }  # fmt: skip


def _shots(rows: list[Any], suite: Any, count: int, account: Account) -> list[Any]:
    """Pictures of failures, one class and method after the other."""
    from dualbrain.cli.evaluation.failure_images import photograph
    from dualbrain.evaluation.report.example_selection import chosen

    shots: list[Any] = []
    for row in chosen(rows, count):
        began = time.monotonic()
        shots.append(photograph(row, suite, time.perf_counter))
        account.print(f"picture of {row.key}  [dim]{time.monotonic() - began:.0f} s[/]")
    return shots
