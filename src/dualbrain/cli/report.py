"""dualbrain report and compare: what an evaluation found, as one HTML file and as tables."""

from __future__ import annotations

import os
import time
from collections.abc import Callable
from contextlib import suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import msgspec
from cyclopts import Parameter

from dualbrain.cli.console import Account, answer
from dualbrain.cli.exits import Exit
from dualbrain.errors import DualbrainError, InvalidSetup, WrongUsage

Flag = Annotated[bool, Parameter(negative="")]
FLOWN = "flown"
"""Entry of a table's configuration: the day of its last flight."""


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
    from dualbrain.cli.graphics import choose_graphics

    blind = choose_graphics(os.environ)
    from dualbrain.dashboard.evaluation_page import PAGE, write_page
    from dualbrain.dashboard.evaluation_report import Told, write_evaluation
    from dualbrain.evaluation.plans import Plans
    from dualbrain.evaluation.table_file import FILE, without_trace, write_table
    from dualbrain.evaluation.work import PLANS

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
    from dualbrain.evaluation.changes import changed, changes, otherwise
    from dualbrain.evaluation.markdown import grid_lines

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


def tell_left_out(line: str) -> None:
    """Tell a person what could not be read, or is not there to be shown."""
    Account().print(f"left out: {line}", markup=False, soft_wrap=True)


def results(
    folder: Path, left_out: Callable[[str], None] | None = None
) -> tuple[list[Any], dict[str, Any], Any]:  # fmt: skip
    """Rows, configuration and suite of the results in `folder`; of a run under way, what is done of it.

    `left_out` is told of what cannot be read where the rest can be; without it, and where nothing can be read, raises
    `InvalidSetup`.
    """
    from dualbrain.evaluation.runner import CONFIG, suite_of
    from dualbrain.evaluation.table_file import FILE, read_table

    path, journal = folder / FILE, folder / "fly.jsonl"
    if (folder / CONFIG).is_file() and journal.is_file() and not _is_newer(path, journal):
        try:
            found = _under_way(folder, left_out)
            if found[0]:
                return found
        except InvalidSetup as why:
            if left_out is None or not path.is_file():
                raise
            left_out(f"What was flown since {FILE} was written ({why})")
    if not path.is_file():
        raise _no_results(folder)
    rows, config = read_table(path)
    return rows, config, suite_of(config, path)


def _under_way(folder: Path, left_out: Callable[[str], None] | None) -> tuple[list[Any], dict[str, Any], Any]:
    """Rows, configuration and suite as the journals have them; raises `InvalidSetup`."""
    from dualbrain.evaluation.runner import CONFIG, Runner, read_config, suite_of

    config = read_config(folder / CONFIG)
    suite = suite_of(config, folder / CONFIG)
    runner = Runner(suite, folder, clock=time.monotonic, tell=lambda progress: None)
    return runner.rows(left_out), config, suite


def _no_results(folder: Path) -> InvalidSetup:
    """Why there are no results in `folder`, and by which command they come."""
    from dualbrain.dashboard.evaluation_page import PAGE
    from dualbrain.evaluation.runner import CONFIG, read_config, suite_of
    from dualbrain.evaluation.table_file import FILE

    got, fix = "none", f"Fly them first: dualbrain evaluate --suite SUITE --out {folder}"
    if folder.is_file():
        got, fix = "a file", "Name the folder that it lies in."
    elif (folder / CONFIG).is_file():
        suite = suite_of(read_config(folder / CONFIG), folder / CONFIG)
        got, fix = "no episode that is finished", f"Go on with it: {_command(suite, str(folder))}"
    elif (folder / PAGE).is_file():
        got = "a page without its table"
        fix = f"The page names the command by which it was flown: fly that into another folder. {folder / PAGE}"
    return InvalidSetup("results", got=got, allowed=f"a folder with {FILE}", fix=fix)


def _is_newer(table: Path, journal: Path) -> bool:
    """Whether the table was written after the last line of the journal."""
    return table.is_file() and table.stat().st_mtime_ns >= journal.stat().st_mtime_ns


def flown_on(folder: Path, config: dict[str, Any]) -> str:
    """The day on which the last episode was flown, UTC: by the journal, or without one as the table's `config` says."""
    from dualbrain.evaluation.table_file import FILE

    journal = folder / "fly.jsonl"
    if FLOWN in config and not journal.is_file():
        return str(config[FLOWN])
    written = (journal if journal.is_file() else folder / FILE).stat().st_mtime
    return datetime.fromtimestamp(written, UTC).strftime("%Y-%m-%d")


def command_of(suite: Any, folder: Path) -> str:
    """The command that flies `suite` into a folder of that name: one that is shipped, with all that differs from it.

    What no options lead to came from a file.
    """
    return _command(suite, folder.name)


def _command(suite: Any, out: str) -> str:
    from dualbrain.cli.evaluate import narrowed
    from dualbrain.evaluation.suite import open_suite, shipped

    options: dict[str, str] = {}
    if suite.name in shipped():
        ours = open_suite(suite.name)
        others = {part: name for part, name in suite.planners.items() if ours.planners.get(part) != name}
        options |= {"methods": ",".join(suite.methods)} if suite.methods != ours.methods else {}
        options |= {"planner": ",".join(f"{part}={name}" for part, name in others.items())} if others else {}
        options |= {"robots": ",".join(suite.robots)} if suite.robots != ours.robots else {}
        options |= {"episodes": str(suite.episodes)} if suite.episodes != ours.episodes else {}
        again = {name: options.get(name, "") for name in ("methods", "robots", "planner")}
        with suppress(DualbrainError):  # what was flown by another version may be refused by this one
            if narrowed(suite.name, episodes=int(options.get("episodes", 0)), **again) == suite:
                said = [word for name, value in options.items() for word in (f"--{name}", value)]
                return " ".join(["dualbrain evaluate --suite", suite.name, *said, "--out", out])
    return f"dualbrain evaluate --suite FILE.toml --out {out}  # FILE.toml: the suite in {out}/config.json"


def _shots(rows: list[Any], suite: Any, count: int, account: Account) -> list[Any]:
    """Pictures of failures, one class and method after the other."""
    from dualbrain.cli.gallery import photograph
    from dualbrain.evaluation.gallery import chosen

    shots: list[Any] = []
    for row in chosen(rows, count):
        began = time.monotonic()
        shots.append(photograph(row, suite, time.perf_counter))
        account.print(f"picture of {row.key}  [dim]{time.monotonic() - began:.0f} s[/]")
    return shots
