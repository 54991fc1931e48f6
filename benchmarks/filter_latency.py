"""One step of the safety filter beside other people's, in one run: latency, first call, infeasible problems, clearance.

Run: python benchmarks/peers/setup_environments.py, then
     python benchmarks/filter_latency.py [--json] [--write-docs] [--only UNIT ...] [--fresh] [--quick]

Every contestant lives in a process of its own; all are fed the same recorded states in alternating blocks, so that the
machine's load hits all alike, and a ratio is the peer's median over ours of the same unit. Each finished unit is
written to build/peers/figures.jsonl and not measured again for the same kernel unless --fresh is given. Progress goes
to stderr, the result to stdout.
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
from dualbrain.safety.cbf.kernel import kernel_hash
from experiments.engine.provenance import machine, revision

ROOT = Path(__file__).resolve().parents[1]
RESULTS_FILE = ENVIRONMENTS / "figures.jsonl"


def units(*, quick: bool) -> dict[str, Callable[[], dict[str, Any]]]:
    """What there is to measure, by name."""
    if quick:
        return {
            "rows:10": lambda: latency.measure("rows", 10, QUICK_FILTERS, latency.QUICK_BUDGET),
            "infeasible": lambda: {"infeasible": robustness.measure_infeasible(QUICK_FILTERS[:1])},
            "clearance": lambda: {"clearance": robustness.measure_clearance(QUICK_FILTERS[:1], steps=30, seeds=1)},
        }
    full = latency.MeasurementBudget()
    everybody = {f"rows:{n}": lambda n=n: latency.measure("rows", n, BENCHMARKED_FILTERS, full) for n in ROW_COUNTS}
    able = [c for c in BENCHMARKED_FILTERS if c.in_primitives]
    everybody |= {f"primitives:{n}": lambda n=n: latency.measure("primitives", n, able, full) for n in PRIMITIVE_COUNTS}
    one_each = [c for c in able if not c.is_own or c.name == OWN_NAME]
    everybody["infeasible"] = lambda: {"infeasible": robustness.measure_infeasible(one_each)}
    driven = [c for c in BENCHMARKED_FILTERS if c.gains]
    return everybody | {
        f"clearance:{c.name}": lambda c=c: {"clearance": robustness.measure_clearance([c])} for c in driven
    }


def finished_units() -> dict[str, dict[str, Any]]:
    """Finished units of this kernel, the latest of each name."""
    if not RESULTS_FILE.exists():
        return {}
    lines = [json.loads(line) for line in RESULTS_FILE.read_text().splitlines() if line.strip()]
    return {line["unit"]: line for line in lines if line["kernel"] == kernel_hash()}


def run_units(wanted: list[str], *, quick: bool, fresh: bool) -> dict[str, dict[str, Any]]:
    """Measure what is wanted and not done yet; everything that is known afterwards, by unit."""
    known = {} if quick else finished_units()
    every = units(quick=quick)
    for name in wanted or list(every):
        if name in known and not fresh:
            print(f"{name}: measured already", file=sys.stderr)
            continue
        print(f"{name}: load {os.getloadavg()[0]:.1f}", file=sys.stderr)
        begin = time.monotonic()
        known[name] = {
            "unit": name,
            "kernel": kernel_hash(),
            "revision": revision(ROOT),
            "machine": machine(),
            "load": os.getloadavg()[0],
            "result": every[name](),
            "date": datetime.now(UTC).date().isoformat(),
            "wall_s": time.monotonic() - begin,
        }
        if not quick:
            RESULTS_FILE.parent.mkdir(parents=True, exist_ok=True)
            with RESULTS_FILE.open("a") as file:
                file.write(json.dumps(known[name]) + "\n")
    return {name: known[name] for name in every if name in known}


def collect_results(known: dict[str, dict[str, Any]]) -> dict[str, Any]:
    """One flat object of all units."""
    lists = ("rows", "first_call", "deviation", "refused", "infeasible", "clearance")
    results = [unit["result"] for unit in known.values()]
    whole: dict[str, Any] = {name: [one for result in results for one in result.get(name, [])] for name in lists}
    whole["versions"] = {peer: found for result in results for peer, found in result.get("versions", {}).items()}
    whole["units"] = [
        {key: value for key, value in unit.items() if key != "result"}
        | {key: unit["result"].get(key) for key in ("pairs", "changed_share", "load_before", "load_after")}
        for unit in known.values()
    ]
    whole["bars"] = evaluate_targets(whole["rows"])
    return whole


def format_table(whole: dict[str, Any]) -> str:
    """Latencies and bars for people."""
    lines = [f"{'setting':>10} {'n':>4} {'median µs':>10} {'p99 µs':>10} {'ratio':>7}  contestant"]
    for row in whole["rows"]:
        ratio = "" if row["ratio"] is None else f"{row['ratio']:.1f}"
        times = f"{row['median_us']:>10.1f} {row['p99_us']:>10.1f}"
        lines.append(f"{row['setting']:>10} {row['n']:>4} {times} {ratio:>7}  {row['peer']}")
    lines += [
        f"{'met   ' if bar['met'] else 'missed'} {bar['bar']}: {bar['reached']:.1f} of {bar['wanted']:g} ({bar['by']})"
        for bar in whole["bars"]
    ]
    return "\n".join(lines)


def main() -> None:
    """Measure what is missing, print, and write the document where asked."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.add_argument("--quick", action="store_true", help="only ours and a fake peer, seconds; nothing is kept")
    parser.add_argument("--fresh", action="store_true", help="measure again what was measured")
    parser.add_argument("--only", nargs="+", default=[], metavar="UNIT", choices=list(units(quick=False)))
    parser.add_argument(
        "--write-docs", action="store_true", help="render docs/reference/verification/peers.md from what is known"
    )
    arguments = parser.parse_args()
    whole = collect_results(run_units(arguments.only, quick=arguments.quick, fresh=arguments.fresh))
    if arguments.write_docs and not arguments.quick:
        write_report(whole, ROOT / "docs" / "reference" / "verification" / "peers.md")
    print(json.dumps(whole) if arguments.json else format_table(whole))


if __name__ == "__main__":
    main()
