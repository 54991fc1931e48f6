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
from benchmarks.peers.benchmarked_filters import CONTESTANTS, OWN, QUICK
from benchmarks.peers.problems.scenes import PRIMITIVES, ROWS
from benchmarks.peers.report import write
from benchmarks.peers.setup_environments import ENVIRONMENTS
from benchmarks.peers.targets import bars
from dualbrain.safety.cbf.kernel import kernel_hash
from experiments.engine.provenance import machine, revision

ROOT = Path(__file__).resolve().parents[1]
FIGURES = ENVIRONMENTS / "figures.jsonl"


def units(*, quick: bool) -> dict[str, Callable[[], dict[str, Any]]]:
    """What there is to measure, by name."""
    if quick:
        return {
            "rows:10": lambda: latency.measure("rows", 10, QUICK, latency.QUICK),
            "infeasible": lambda: {"infeasible": robustness.infeasible(QUICK[:1])},
            "clearance": lambda: {"clearance": robustness.clearance(QUICK[:1], steps=30, seeds=1)},
        }
    full = latency.Effort()
    everybody = {f"rows:{n}": lambda n=n: latency.measure("rows", n, CONTESTANTS, full) for n in ROWS}
    able = [c for c in CONTESTANTS if c.primitives]
    everybody |= {f"primitives:{n}": lambda n=n: latency.measure("primitives", n, able, full) for n in PRIMITIVES}
    one_each = [c for c in able if not c.ours or c.name == OWN]
    everybody["infeasible"] = lambda: {"infeasible": robustness.infeasible(one_each)}
    driven = [c for c in CONTESTANTS if c.gains]
    return everybody | {f"clearance:{c.name}": lambda c=c: {"clearance": robustness.clearance([c])} for c in driven}


def done() -> dict[str, dict[str, Any]]:
    """Finished units of this kernel, the latest of each name."""
    if not FIGURES.exists():
        return {}
    lines = [json.loads(line) for line in FIGURES.read_text().splitlines() if line.strip()]
    return {line["unit"]: line for line in lines if line["kernel"] == kernel_hash()}


def carry_out(wanted: list[str], *, quick: bool, fresh: bool) -> dict[str, dict[str, Any]]:
    """Measure what is wanted and not done yet; everything that is known afterwards, by unit."""
    known = {} if quick else done()
    every = units(quick=quick)
    for name in wanted or list(every):
        if name in known and not fresh:
            print(f"{name}: measured already", file=sys.stderr)
            continue
        print(f"{name}: load {os.getloadavg()[0]:.1f}", file=sys.stderr)
        begin = time.monotonic()
        known[name] = {
            "unit": name, "kernel": kernel_hash(), "revision": revision(ROOT), "machine": machine(),
            "load": os.getloadavg()[0], "result": every[name](), "date": datetime.now(UTC).date().isoformat(),
            "wall_s": time.monotonic() - begin,
        }  # fmt: skip
        if not quick:
            FIGURES.parent.mkdir(parents=True, exist_ok=True)
            with FIGURES.open("a") as file:
                file.write(json.dumps(known[name]) + "\n")
    return {name: known[name] for name in every if name in known}


def gather(known: dict[str, dict[str, Any]]) -> dict[str, Any]:
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
    whole["bars"] = bars(whole["rows"])
    return whole


def table(whole: dict[str, Any]) -> str:
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
    parser.add_argument("--write-docs", action="store_true", help="render docs/peers.md from what is known")
    arguments = parser.parse_args()
    whole = gather(carry_out(arguments.only, quick=arguments.quick, fresh=arguments.fresh))
    if arguments.write_docs and not arguments.quick:
        write(whole, ROOT / "docs" / "peers.md")
    print(json.dumps(whole) if arguments.json else table(whole))


if __name__ == "__main__":
    main()
