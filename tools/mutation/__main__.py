"""Mutation check: small mistakes in the kernel and in what compiles its rows; do the tests of the laws notice?

    python -m tools.mutation --seed N --count 60 [--jobs 1] [--resume] [--again] [--write-docs] [--json]

Each mutant changes one place (a sign, an index, a unit factor, a comparison, a constant, a dropped term, a swapped
pair) in a scratch copy, is compiled, and meets tests/safety, tests/invariants and tests/kernel/test_buffer_capacity.py until the
first failure; those go first that hold every number of a step against its definition. Recorded answers (golden hashes,
vectors) and comparisons of builds are left out: they notice every bit and prove nothing. Mutants that do not compile,
or whose object code is that of the original, are counted apart and others are drawn. One JSON line a mutant, written
at once; `--resume` goes on, `--again` also tries the survivors again.
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

from experiments.engine.jsonl_log import JsonlLog
from experiments.engine.provenance import revision
from tools.mutation.report import report_table, summary, write_document
from tools.mutation.sampling import Mutant, sample_mutants, source_files
from tools.mutation.sandbox import BASELINE_FACTOR, MIN_CPU_S, Sandbox

ROOT = Path(__file__).resolve().parents[2]


def main() -> int:
    """Exit code 1 when fewer than 95 of 100 were caught."""
    asked = parse(sys.argv[1:])
    os.nice(asked.nice)
    journal = JsonlLog(asked.folder / f"mutants-{asked.seed}.jsonl")
    if journal.path.exists() and not (asked.resume or asked.again or asked.tables):
        journal.path.rename(journal.path.with_suffix(f".{time.strftime('%Y%m%dT%H%M%S')}.jsonl"))
    sources = source_fingerprint()
    if not asked.tables:
        run_mutants(asked, journal, sources)
    rows = [row for row in journal.rows() if row["sources"] == sources]
    facts = {"seed": asked.seed, "revision": revision(ROOT), **summary(rows)}
    if asked.json:
        sys.stdout.write(json.dumps({**facts, "mutants": rows}) + "\n")
    else:
        sys.stdout.write("\n".join(report_table(facts, rows)) + "\n")
    if asked.write_docs:
        write_document(ROOT / "docs" / "reference" / "verification" / "mutants.md", facts, rows)
    return 0 if facts["caught_share"] >= 0.95 else 1


def parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seed", type=int, default=1)
    parser.add_argument("--count", type=int, default=60, help="mutants that are tested (default 60)")
    parser.add_argument("--jobs", type=int, default=1, help="scratch copies that work at the same time")
    parser.add_argument("--resume", action="store_true", help="keep what the journal holds for these sources")
    parser.add_argument("--again", action="store_true", help="like --resume, but survivors are tried again")
    parser.add_argument("--tables", action="store_true", help="run nothing, only print what is there")
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.add_argument("--write-docs", action="store_true", help="write docs/reference/verification/mutants.md")
    parser.add_argument("--nice", type=int, default=10)
    parser.add_argument("--scratch", type=Path, default=ROOT / "build" / "mutants", help="where the copies are made")
    parser.add_argument(
        "--folder",
        type=Path,
        default=ROOT / "experiments" / "runs",
        help="where the logs are written (default experiments/runs/)",
    )
    return parser.parse_args(arguments)


def source_fingerprint() -> str:
    """A hash over the files that are changed: rows of other sources do not count."""
    return hashlib.sha256(b"".join(path.read_bytes() for path in source_files(ROOT))).hexdigest()[:16]


def run_mutants(asked: argparse.Namespace, journal: JsonlLog, sources: str) -> None:
    """Draw and try mutants until `count` have been tested."""
    known = {row["key"]: row for row in journal.rows() if row["sources"] == sources}
    if asked.again:
        known = {key: row for key, row in known.items() if row["outcome"] != "survived"}
    places: Queue[Sandbox] = Queue()
    limit, seconds = baseline(asked)
    kills = Counter(row.get("test", "") for row in journal.rows())
    order = write_test_order(asked.scratch / "order.json", seconds, kills)
    for job in range(asked.jobs):
        place = Sandbox(ROOT, asked.scratch / f"job{job}", limit)
        place.prepare()
        places.put(place)
    tested = 0
    for mutant, row in run_attempts(sample_mutants(ROOT, asked.seed), known, places, order, asked):
        if row is not known.get(mutant.key):
            journal.append({**row, "sources": sources, "revision": revision(ROOT)})
        tested += row["outcome"] in ("caught", "survived")
        kills[row.get("test", "")] += 1
        write_test_order(order, seconds, kills)
        said = f"{row.get('by', '')} {row.get('test', '')} {row.get('seconds', '')}"
        where = f"{mutant.file}:{mutant.line} {mutant.kind} | {mutant.after}"
        print(f"{tested}/{asked.count} {row['outcome']:8} {where} | {said}", file=sys.stderr, flush=True)


def baseline(asked: argparse.Namespace) -> tuple[float, dict[str, float]]:
    """Processor time [s] that a mutant's tests may take, and what each test takes. The original must pass."""
    place = Sandbox(ROOT, asked.scratch / "job0", 600.0)
    place.prepare()
    verdict, rows = place.run_tests(first_failure=False)
    if verdict.caught:
        sys.exit(f"the unmutated project fails its tests: {verdict.test}")
    seconds = {row["test"]: row["seconds"] for row in rows if "seconds" in row}
    print(f"unmutated: {len(seconds)} tests pass in {verdict.seconds} s of processor time", file=sys.stderr, flush=True)
    return max(MIN_CPU_S, BASELINE_FACTOR * verdict.seconds), seconds


def write_test_order(path: Path, seconds: dict[str, float], kills: Counter[str]) -> Path:
    """The order of tests: what caught many mutants in little time goes first. What is caught does not depend on it."""
    fresh = path.with_suffix(".new")
    fresh.write_text(json.dumps(sorted(seconds, key=lambda name: (seconds[name] + 0.02) / (kills[name] + 0.05))))
    return fresh.replace(path)


def run_attempts(
    drawn: Iterator[Mutant], known: dict[str, dict], places: Queue[Sandbox], order: Path, asked: argparse.Namespace
) -> Iterator[tuple[Mutant, dict]]:
    """Mutants and their rows as they finish; as many under way as there are scratch copies."""
    done, under_way = 0, dict[Future, Mutant]()
    with ThreadPoolExecutor(asked.jobs) as pool:
        while True:
            while done + len(under_way) < asked.count and len(under_way) < asked.jobs:
                mutant = next(drawn, None)
                if mutant is None:
                    break
                if mutant.key in known:
                    done += known[mutant.key]["outcome"] in ("caught", "survived")
                    yield mutant, known[mutant.key]
                    continue
                under_way[pool.submit(test_mutant, mutant, places, order)] = mutant
            if not under_way:
                return
            for ready in wait(under_way, return_when=FIRST_COMPLETED).done:
                mutant, row = under_way.pop(ready), ready.result()
                done += row["outcome"] in ("caught", "survived")
                yield mutant, row


def test_mutant(mutant: Mutant, places: Queue[Sandbox], order: Path) -> dict:
    """One row: what became of this mutant."""
    place = places.get()
    try:
        why = place.apply(mutant)
        row = {"key": mutant.key, **mutant.record()}
        if why:
            return {**row, "outcome": why}
        verdict, _ = place.run_tests(order)
        outcome = "caught" if verdict.caught else "survived"
        return {**row, "outcome": outcome, "by": verdict.by, "test": verdict.test, "seconds": verdict.seconds}
    finally:
        place.revert(mutant)
        places.put(place)


if __name__ == "__main__":
    sys.exit(main())
