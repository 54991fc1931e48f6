"""The big proofs: slow, resumable, one JSON row a finished unit in `experiments/runs/<name>.jsonl`.

    python -m experiments [NAME ...] [--jobs 2] [--limit N] [--planner NAME] [--fresh] [--write-docs]

What is finished is skipped, so a run that was stopped (or killed) goes on where it was. Progress goes to stderr, tables
to stdout; `--write-docs` renders them into docs/proofs.md, and the sweep into docs/learnable.md and its plot.

`--keep` packs a log into experiments/journals, where it is committed: a proof of hours goes on from there in another
checkout, and its figures can be counted again (`xzcat` shows it). `--fresh` forgets it.
"""

from __future__ import annotations

import argparse
import sys
import time
from pathlib import Path

from dualbrain.planner.registry import DEFAULT_PLANNER
from experiments.engine.catalogue import EXPERIMENTS
from experiments.engine.documents import write_documents
from experiments.engine.experiment import Experiment, Options
from experiments.engine.jsonl_log import JsonlLog
from experiments.engine.provenance import revision
from experiments.engine.worker_pool import run_units

ROOT = Path(__file__).resolve().parents[1]
JOURNALS = ROOT / "experiments" / "journals"
"""Journals that are committed."""


def main() -> int:
    """Exit code 1 when a unit broke (an error, not a refuted claim)."""
    asked = parse(sys.argv[1:])
    options = Options(asked.folder, asked.planner)
    names = asked.names or list(EXPERIMENTS)
    whole = True
    for name in names:
        journal, kept = JsonlLog(asked.folder / f"{name}.jsonl"), kept_log(EXPERIMENTS[name])
        if not asked.fresh:
            journal.restore_from(kept)
        if not asked.tables:
            whole &= run_missing_units(EXPERIMENTS[name], options, asked)
        if asked.keep:
            journal.pack_to(kept)
        sys.stdout.write("\n".join(report_lines(EXPERIMENTS[name], asked.folder)) + "\n")
        sys.stdout.flush()
    if asked.write_docs:
        write_documents(EXPERIMENTS.values(), asked.folder, ROOT / "docs")
    return 0 if whole else 1


def kept_log(experiment: Experiment) -> Path:
    """The committed log of an experiment, by the group that its module belongs to."""
    return JOURNALS / type(experiment).__module__.split(".")[1] / f"{experiment.name}.jsonl.xz"


def parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME", choices=[[], *EXPERIMENTS], help=", ".join(EXPERIMENTS))
    parser.add_argument("--jobs", type=int, default=2, help="processes (default 2)")
    parser.add_argument("--limit", type=int, help="consider only the first N units of each proof")
    parser.add_argument("--planner", default=DEFAULT_PLANNER, help="for runs: name, URL or contract file (.json)")
    parser.add_argument("--nice", type=int, default=5, help="niceness of the workers (default 5)")
    parser.add_argument("--fresh", action="store_true", help="set the old journal aside and start anew")
    parser.add_argument("--tables", action="store_true", help="run nothing, only print what is there")
    parser.add_argument("--write-docs", action="store_true", help="render the figures into docs/")
    parser.add_argument("--keep", action="store_true", help="copy the logs to experiments/journals, to be committed")
    parser.add_argument(
        "--folder",
        type=Path,
        default=ROOT / "experiments" / "runs",
        help="where the logs are written (default experiments/runs/)",
    )
    return parser.parse_args(arguments)


def run_missing_units(proof: Experiment, options: Options, asked: argparse.Namespace) -> bool:
    """Do what is not done yet; whether all of it ended without an error."""
    journal = JsonlLog(options.folder / f"{proof.name}.jsonl")
    if asked.fresh and journal.path.exists():
        journal.path.rename(journal.path.with_suffix(f".{time.strftime('%Y%m%dT%H%M%S')}.jsonl"))
    units = proof.units(options)[: asked.limit]
    finished = journal.finished_keys()
    left = [unit for unit in units if unit.key not in finished]
    began, broken, code = time.monotonic(), 0, revision(ROOT)
    for count, row in enumerate(run_units(proof.name, left, asked.jobs, asked.nice), start=1):
        journal.append({**row, "revision": code, "date": time.strftime("%Y-%m-%d", time.gmtime())})
        broken += "error" in row
        spent = time.monotonic() - began
        ahead = spent / count * (len(left) - count)
        text = row["error"] if "error" in row else proof.summarize_row(row)
        done = len(units) - len(left) + count
        print(
            f"{proof.name} {done}/{len(units)}, {format_duration(ahead)} left | {row['key']} | {text}",
            file=sys.stderr,
            flush=True,
        )
    return not broken


def report_lines(proof: Experiment, folder: Path) -> list[str]:
    """The table at the end."""
    rows = JsonlLog(folder / f"{proof.name}.jsonl").rows()
    broken = [row for row in rows if "error" in row]
    good = [row for row in rows if "error" not in row]
    lines = ["", f"## {proof.name}: {proof.claim}", "", *(proof.report(good) if good else ["nothing done yet"])]
    return lines + [f"broken: {row['key']}: {row['error']}" for row in broken]


def format_duration(seconds: float) -> str:
    """Hours, minutes and seconds."""
    minutes, rest = divmod(round(seconds), 60)
    return f"{minutes // 60}h{minutes % 60:02d}m" if minutes >= 60 else f"{minutes}m{rest:02d}s"


if __name__ == "__main__":
    sys.exit(main())
