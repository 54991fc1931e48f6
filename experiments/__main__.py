"""Run the experiments: slow, resumable, with one JSON row per finished unit in `experiments/runs/<name>.jsonl`.

    python -m experiments [NAME ...] [--jobs 2] [--limit N] [--planner NAME] [--fresh] [--write-docs]

Finished units are skipped, so an experiment that was stopped or killed continues where it was. Progress goes to stderr,
tables to stdout. `--write-docs` renders them into docs/experiments/<group>/<name>.md, below the marker line; the text
above that line is written by hand and stays. The documents of the evidence package are copied from the pages
and from SAFETY.md.

`--keep` packs a log into experiments/logs, where it is committed: an experiment of many hours continues from there in
another checkout, and its tables can be made again (`--tables`; `xzcat` shows the rows). `--fresh` ignores it.
"""

from __future__ import annotations

import argparse
import math
import sys
import time
from functools import partial
from pathlib import Path

from dualbrain.core.storage.jsonl_log import JsonlLog
from dualbrain.evaluation.runner.provenance import git_revision, machine_description
from dualbrain.evaluation.runner.worker_pool import ProcessPool
from dualbrain.planner.registry import DEFAULT_PLANNER
from experiments.engine.catalogue import EXPERIMENTS
from experiments.engine.documents import write_index, write_pages
from experiments.engine.evidence_documents import write_copies
from experiments.engine.experiment import Experiment, Options, group_of, unit_runner

ROOT = Path(__file__).resolve().parents[1]
LOGS = ROOT / "experiments" / "logs"
"""Committed logs, packed."""
SOURCE_FOLDERS = ("src", "kernel", "experiments")
"""Folders whose uncommitted changes are part of the revision."""


def main() -> int:
    """Run the experiments named on the command line; exit code 1 if a unit failed (a refuted claim is no failure)."""
    arguments = parse(sys.argv[1:])
    options = Options(arguments.folder, arguments.planner)
    names = arguments.names or list(EXPERIMENTS)
    complete = True
    for name in names:
        experiment = EXPERIMENTS[name]
        log, archive = JsonlLog(arguments.folder / f"{name}.jsonl"), archived_log(experiment)
        if not arguments.fresh:
            log.restore_from(archive)
        if not arguments.tables:
            complete &= run_missing_units(experiment, log, options, arguments)
        if arguments.keep:
            log.pack_to(archive)
        sys.stdout.write("\n".join(report_lines(experiment, log)) + "\n")
        sys.stdout.flush()
    if arguments.write_docs:
        write_pages([EXPERIMENTS[name] for name in names], arguments.folder, ROOT / "docs")
        write_index(EXPERIMENTS.values(), ROOT / "docs")
        write_copies(ROOT)
    return 0 if complete else 1


def archived_log(experiment: Experiment) -> Path:
    """The committed log of an experiment, in the folder of its group."""
    return LOGS / group_of(experiment) / f"{experiment.name}.jsonl.xz"


def parse(arguments: list[str]) -> argparse.Namespace:
    """The parsed command line."""
    parser = argparse.ArgumentParser(
        prog="python -m experiments", description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("names", nargs="*", metavar="NAME", choices=[[], *EXPERIMENTS], help=", ".join(EXPERIMENTS))
    parser.add_argument("--jobs", type=int, default=2, help="number of worker processes (default 2)")
    parser.add_argument("--limit", type=int, help="run only the first N units of each experiment")
    parser.add_argument(
        "--planner", default=DEFAULT_PLANNER, help="planner under test: name, URL or contract file (.json)"
    )
    parser.add_argument("--nice", type=int, default=5, help="niceness of the workers (default 5)")
    parser.add_argument("--fresh", action="store_true", help="rename the existing log and start again")
    parser.add_argument("--tables", action="store_true", help="run nothing, only print the tables of the logs")
    parser.add_argument("--write-docs", action="store_true", help="render the tables into docs/experiments/")
    parser.add_argument("--keep", action="store_true", help="pack the logs into experiments/logs, to be committed")
    parser.add_argument(
        "--folder",
        type=Path,
        default=ROOT / "experiments" / "runs",
        help="where the logs are written (default experiments/runs/)",
    )
    return parser.parse_args(arguments)


def run_missing_units(experiment: Experiment, log: JsonlLog, options: Options, arguments: argparse.Namespace) -> bool:
    """Run the units that the log lacks; True if none of them failed."""
    if arguments.fresh and log.path.exists():
        log.path.rename(log.path.with_suffix(f".{time.strftime('%Y%m%dT%H%M%S')}.jsonl"))
    units = experiment.units(options)[: arguments.limit]
    finished = log.finished_keys()
    left = [unit for unit in units if unit.key not in finished]
    provenance = {"revision": git_revision(ROOT / "experiments", SOURCE_FOLDERS), "machine": machine_description()}
    pool = ProcessPool(
        partial(unit_runner, experiment), arguments.jobs, niceness=arguments.nice, timeout_s=math.inf
    )  # a unit may take hours and reports only at its end
    start, done, failed = time.monotonic(), 0, 0
    for report in pool.run_units(left):
        if report.line is None and not report.error:
            continue
        row = report.line or {"key": report.unit.key, "error": report.error, "traceback": report.traceback}
        log.append({**row, **provenance, "date": time.strftime("%Y-%m-%d", time.gmtime())})
        done += 1
        failed += bool(report.error)
        seconds_left = (time.monotonic() - start) / done * (len(left) - done)
        text = report.error or experiment.summarize_row(row)
        count = f"{len(units) - len(left) + done}/{len(units)}"
        print(
            f"{experiment.name} {count}, {format_duration(seconds_left)} left | {row['key']} | {text}",
            file=sys.stderr,
            flush=True,
        )
    return not failed


def report_lines(experiment: Experiment, log: JsonlLog) -> list[str]:
    """The tables of the finished units, and the units that failed."""
    rows = log.latest()
    failed = [row for row in rows if "error" in row]
    good = [row for row in rows if "error" not in row]
    tables = experiment.report(good) if good else ["No unit is finished."]
    lines = ["", f"## {experiment.name}: {experiment.claim}", "", *tables]
    return lines + [f"failed: {row['key']}: {row['error']}" for row in failed]


def format_duration(seconds: float) -> str:
    """A duration in hours and minutes, or in minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}h{minutes % 60:02d}m" if minutes >= 60 else f"{minutes}m{rest:02d}s"


if __name__ == "__main__":
    sys.exit(main())
