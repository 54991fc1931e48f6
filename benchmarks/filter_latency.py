"""One step of the safety filter, compared with other libraries: latency, first call, infeasible problems, clearance.

Run: python -m benchmarks.peers.setup_environments, then
     python -m benchmarks.filter_latency [--json] [--write-docs] [--only UNIT ...] [--fresh] [--quick]

Each filter runs in a separate process. All filters compute the same recorded states in alternating blocks, so that
other load on the machine affects all of them; a ratio is the median of a peer divided by the median of dualbrain in
the same unit. Each finished unit is written to build/peers/figures.jsonl and is not measured again for the same kernel
unless --fresh is given. Progress is printed on stderr, the result on stdout.
"""

from __future__ import annotations

import argparse
import json
import os
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from benchmarks.peers import latency, robustness
from benchmarks.peers.benchmarked_filters import BENCHMARKED_FILTERS, OWN_NAME, QUICK_FILTERS
from benchmarks.peers.problems.scenes import PRIMITIVE_COUNTS, ROW_COUNTS
from benchmarks.peers.report import write_report
from benchmarks.peers.setup_environments import ENVIRONMENTS
from benchmarks.peers.targets import evaluate_targets
from dualbrain.core.storage.jsonl_log import JsonlLog
from dualbrain.evaluation.runner.provenance import git_revision, machine_description
from dualbrain.safety.cbf.kernel import kernel_hash

ROOT = Path(__file__).resolve().parents[1]
RESULTS_FILE = ENVIRONMENTS / "figures.jsonl"


def units(*, quick: bool) -> dict[str, Callable[[], dict[str, Any]]]:
    """Return the measurements by name."""
    if quick:
        return {
            "rows:10": lambda: latency.measure("rows", 10, QUICK_FILTERS, latency.QUICK_BUDGET),
            "infeasible": lambda: {"infeasible": robustness.measure_infeasible(QUICK_FILTERS[:1])},
            "clearance": lambda: {"clearance": robustness.measure_clearance(QUICK_FILTERS[:1], steps=30, seeds=1)},
        }
    full = latency.MeasurementBudget()
    every = {f"rows:{n}": lambda n=n: latency.measure("rows", n, BENCHMARKED_FILTERS, full) for n in ROW_COUNTS}
    in_primitives = [c for c in BENCHMARKED_FILTERS if c.in_primitives]
    every |= {
        f"primitives:{n}": lambda n=n: latency.measure("primitives", n, in_primitives, full) for n in PRIMITIVE_COUNTS
    }
    one_each = [c for c in in_primitives if not c.is_own or c.name == OWN_NAME]
    every["infeasible"] = lambda: {"infeasible": robustness.measure_infeasible(one_each)}
    in_closed_loop = [c for c in BENCHMARKED_FILTERS if c.gains]
    return every | {
        f"clearance:{c.name}": lambda c=c: {"clearance": robustness.measure_clearance([c])} for c in in_closed_loop
    }


def finished_units() -> dict[str, dict[str, Any]]:
    """Return the latest finished unit of each name for the present kernel."""
    return {line["unit"]: line for line in JsonlLog(RESULTS_FILE).read() if line["kernel"] == kernel_hash()}


def run_units(names: list[str], *, quick: bool, fresh: bool) -> dict[str, dict[str, Any]]:
    """Measure the unfinished units among `names` (all if empty); returns all finished units by name."""
    finished = {} if quick else finished_units()
    every = units(quick=quick)
    for name in names or list(every):
        if name in finished and not fresh:
            print(f"{name}: measured already", file=sys.stderr)
            continue
        print(f"{name}: load {os.getloadavg()[0]:.1f}", file=sys.stderr)
        start = time.monotonic()
        finished[name] = {
            "unit": name,
            "kernel": kernel_hash(),
            "revision": git_revision(ROOT / "benchmarks", ("src", "kernel", "benchmarks")),
            "machine": machine_description(),
            "load": os.getloadavg()[0],
            "result": every[name](),
            "date": datetime.now(UTC).date().isoformat(),
            "wall_s": time.monotonic() - start,
        }
        if not quick:
            JsonlLog(RESULTS_FILE).append(finished[name])
    return {name: finished[name] for name in every if name in finished}


def collect_results(finished: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """Return the results of all units as one object."""
    lists = ("rows", "first_call", "deviation", "refused", "infeasible", "clearance")
    results = [unit["result"] for unit in finished.values()]
    whole: dict[str, Any] = {name: [one for result in results for one in result.get(name, [])] for name in lists}
    whole["versions"] = {peer: found for result in results for peer, found in result.get("versions", {}).items()}
    whole["units"] = [
        {key: value for key, value in unit.items() if key != "result"}
        | {key: unit["result"].get(key) for key in ("pairs", "changed_share", "load_before", "load_after")}
        for unit in finished.values()
    ]
    whole["targets"] = evaluate_targets(whole["rows"])
    return whole


def format_table(whole: dict[str, Any]) -> str:
    """Return a printable table of latencies and targets."""
    lines = [f"{'setting':>10} {'n':>4} {'median µs':>10} {'p99 µs':>10} {'ratio':>7}  filter"]
    for row in whole["rows"]:
        ratio = "" if row["ratio"] is None else f"{row['ratio']:.1f}"
        times = f"{row['median_us']:>10.1f} {row['p99_us']:>10.1f}"
        lines.append(f"{row['setting']:>10} {row['n']:>4} {times} {ratio:>7}  {row['peer']}")
    lines += [
        f"{'met   ' if one['met'] else 'missed'} {one['target']}: {one['reached']:.1f} of {one['required']:g} "
        f"({one['by']})"
        for one in whole["targets"]
    ]
    return "\n".join(lines)


def main() -> None:
    """Measure the missing units, print the results, and write the document if requested."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.add_argument(
        "--quick", action="store_true", help="only dualbrain and a fake peer, for seconds; stores nothing"
    )
    parser.add_argument("--fresh", action="store_true", help="measure finished units again")
    parser.add_argument("--only", nargs="+", default=[], metavar="UNIT", choices=list(units(quick=False)))
    parser.add_argument(
        "--write-docs", action="store_true", help="render docs/reference/verification/peers.md from the finished units"
    )
    arguments = parser.parse_args()
    whole = collect_results(run_units(arguments.only, quick=arguments.quick, fresh=arguments.fresh))
    if arguments.write_docs and not arguments.quick:
        write_report(whole, ROOT / "docs" / "reference" / "verification" / "peers.md")
    print(json.dumps(whole) if arguments.json else format_table(whole))


if __name__ == "__main__":
    main()
