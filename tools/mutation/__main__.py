"""Mutation test: small faults in the kernel and in the module that compiles its rows; do the tests detect them?

    python -m tools.mutation --seed N --count 60 [--jobs 1] [--resume] [--again] [--write-docs] [--json]

Each mutant changes one place (a sign, an index, a unit factor, a comparison, a constant, a dropped term, a swapped
pair) in a copy of the project, is compiled, and is tested with tests/safety, tests/invariants and
tests/kernel/test_buffer_capacity.py until the first failure; tests that compare every value of a step with its
definition run first. Recorded results (golden hashes, vectors) and comparisons of builds are excluded: they detect
every changed bit and test no property. Mutants that do not compile, or whose object code equals the original, are
counted separately and replaced. Each mutant is written to the log at once as a JSON line; `--resume` continues a log,
`--again` also repeats the surviving mutants.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import sys
import time
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from pathlib import Path
from queue import Queue

from dualbrain.core.storage.jsonl_log import JsonlLog
from dualbrain.evaluation.runner.provenance import git_revision
from tools.mutation.report import report_table, summary, write_document
from tools.mutation.sampling import Mutant, sample_mutants, source_files
from tools.mutation.sandbox import BASELINE_FACTOR, MIN_CPU_S, Sandbox

ROOT = Path(__file__).resolve().parents[2]
REVISION_FOLDERS = ("src", "kernel", "tests", "tools")
"""Folders whose uncommitted changes are part of the revision."""


def main() -> int:
    """Return exit code 1 if the tests detect less than 95 % of the mutants."""
    options = parse(sys.argv[1:])
    os.nice(options.nice)
    log = JsonlLog(options.folder / f"mutants-{options.seed}.jsonl")
    if log.path.exists() and not (options.resume or options.again or options.tables):
        log.path.rename(log.path.with_suffix(f".{time.strftime('%Y%m%dT%H%M%S')}.jsonl"))
    sources = source_fingerprint()
    if not options.tables:
        run_mutants(options, log, sources)
    rows = [row for row in log.latest() if row["sources"] == sources]
    facts = {"seed": options.seed, "revision": git_revision(ROOT / "tools", REVISION_FOLDERS), **summary(rows)}
    if options.json:
        sys.stdout.write(json.dumps({**facts, "mutants": rows}) + "\n")
    else:
        sys.stdout.write("\n".join(report_table(facts, rows)) + "\n")
    if options.write_docs:
        write_document(ROOT / "docs" / "reference" / "verification" / "mutants.md", facts, rows)
    return 0 if facts["caught_share"] >= 0.95 else 1


def parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=60, help="number of mutants to test (default 60)")
    parser.add_argument("--jobs", type=int, default=1, help="number of parallel copies")
    parser.add_argument("--resume", action="store_true", help="continue the log of the same sources")
    parser.add_argument("--again", action="store_true", help="like --resume, but repeat the surviving mutants")
    parser.add_argument("--tables", action="store_true", help="run nothing, print the tables of the log")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.add_argument("--write-docs", action="store_true", help="write docs/reference/verification/mutants.md")
    parser.add_argument("--nice", type=int, default=10)
    parser.add_argument("--scratch", type=Path, default=ROOT / "build" / "mutants", help="folder of the copies")
    parser.add_argument(
        "--folder",
        type=Path,
        default=ROOT / "experiments" / "runs",
        help="folder of the logs (default experiments/runs/)",
    )
    return parser.parse_args(arguments)


def source_fingerprint() -> str:
    """Return a hash of the mutated files; rows of other sources do not count."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in source_files(ROOT))).hexdigest()[:16]


def run_mutants(options: argparse.Namespace, log: JsonlLog, sources: str) -> None:
    """Test random mutants until `count` have been tested."""
    known = {row["key"]: row for row in log.latest() if row["sources"] == sources}
    if options.again:
        known = {key: row for key, row in known.items() if row["outcome"] != "survived"}
    sandboxes: Queue[Sandbox] = Queue()
    limit, seconds = baseline(options)
    kills = Counter(row.get("test", "") for row in log.latest())
    order = write_test_order(options.scratch / "order.json", seconds, kills)
    for job in range(options.jobs):
        sandbox = Sandbox(ROOT, options.scratch / f"job{job}", limit)
        sandbox.prepare()
        sandboxes.put(sandbox)
    tested = 0
    for mutant, row in run_attempts(sample_mutants(ROOT, options.seed), known, sandboxes, order, options):
        if row is not known.get(mutant.key):
            log.append({**row, "sources": sources, "revision": git_revision(ROOT / "tools", REVISION_FOLDERS)})
        tested += row["outcome"] in ("caught", "survived")
        kills[row.get("test", "")] += 1
        write_test_order(order, seconds, kills)
        verdict = f"{row.get('by', '')} {row.get('test', '')} {row.get('seconds', '')}"
        change = f"{mutant.file}:{mutant.line} {mutant.kind} | {mutant.after}"
        print(f"{tested}/{options.count} {row['outcome']:8} {change} | {verdict}", file=sys.stderr, flush=True)


def baseline(options: argparse.Namespace) -> tuple[float, dict[str, float]]:
    """Run the tests of the original, which must pass; returns the time limit of a mutant and the test times [s]."""
    sandbox = Sandbox(ROOT, options.scratch / "job0", 600.0)
    sandbox.prepare()
    verdict, rows = sandbox.run_tests(first_failure=False)
    if verdict.caught:
        sys.exit(f"The unmutated project fails a test: {verdict.test}")
    seconds = {row["test"]: row["seconds"] for row in rows if "seconds" in row}
    print(f"unmutated: {len(seconds)} tests pass in {verdict.seconds} s of processor time", file=sys.stderr, flush=True)
    return max(MIN_CPU_S, BASELINE_FACTOR * verdict.seconds), seconds


def write_test_order(path: Path, seconds: dict[str, float], kills: Counter[str]) -> Path:
    """Write the order of the tests: those that detect many mutants in little time run first."""
    fresh = path.with_suffix(".new")
    fresh.write_text(json.dumps(sorted(seconds, key=lambda name: (seconds[name] + 0.02) / (kills[name] + 0.05))))
    return fresh.replace(path)


def run_attempts(
    mutants: Iterator[Mutant],
    known: dict[str, dict],
    sandboxes: Queue[Sandbox],
    order: Path,
    options: argparse.Namespace,
) -> Iterator[tuple[Mutant, dict]]:
    """Yield mutants and their rows as they finish; one mutant runs in each copy."""
    done, running = 0, dict[Future, Mutant]()
    with ThreadPoolExecutor(options.jobs) as pool:
        while True:
            while done + len(running) < options.count and len(running) < options.jobs:
                mutant = next(mutants, None)
                if mutant is None:
                    break
                if mutant.key in known:
                    done += known[mutant.key]["outcome"] in ("caught", "survived")
                    yield mutant, known[mutant.key]
                    continue
                running[pool.submit(test_mutant, mutant, sandboxes, order)] = mutant
            if not running:
                return
            for ready in wait(running, return_when=FIRST_COMPLETED).done:
                mutant, row = running.pop(ready), ready.result()
                done += row["outcome"] in ("caught", "survived")
                yield mutant, row


def test_mutant(mutant: Mutant, sandboxes: Queue[Sandbox], order: Path) -> dict:
    """Test a mutant and return its row."""
    sandbox = sandboxes.get()
    try:
        reason = sandbox.apply(mutant)
        row = {"key": mutant.key, **mutant.record()}
        if reason:
            return {**row, "outcome": reason}
        verdict, _ = sandbox.run_tests(order)
        outcome = "caught" if verdict.caught else "survived"
        return {**row, "outcome": outcome, "by": verdict.by, "test": verdict.test, "seconds": verdict.seconds}
    finally:
        sandbox.revert(mutant)
        sandboxes.put(sandbox)


if __name__ == "__main__":
    sys.exit(main())
