"""Worst case of the kernel: stack, memory, code size, QP iterations and time of one step.

    python -m tools.kernel_limits [--json] [--write-docs] [--scenes 12] [--steps 10000] [--tries 3000]

Stack, calls and symbols are read from the compiled objects; the exit code is 1 if there is recursion, or a reference to
heap or libm. Iterations, rows and times are measured in adversarial closed loops of the default Panda filter, and by a
search for the worst step that starts from the worst steps of the loops.
"""

from __future__ import annotations

import argparse
import json
import sys
import tempfile
from pathlib import Path

import numpy as np

from dualbrain.evaluation.runner.provenance import git_revision, machine_description
from dualbrain.safety.cbf.kernel import kernel_hash
from tools.kernel_limits.compiled import ROOT, measure, targets
from tools.kernel_limits.report import render_page, report_tables
from tools.kernel_limits.worst_case_search import (
    adversarial_loop,
    load_panda,
    make_filter,
    repeat_cold,
    search_worst_qp,
    search_worst_step,
)


def main() -> int:
    """Return exit code 1 if an object refers to a library, takes an address of a function, or recurses."""
    options = parse(sys.argv[1:])
    with tempfile.TemporaryDirectory() as folder:
        compiled = [measure(target, Path(folder) / str(i)) for i, target in enumerate(targets())]
    found = {
        "revision": git_revision(ROOT / "tools", ("src", "kernel", "tools")),
        "kernel": kernel_hash(),
        "machine": machine_description(),
        "compiled": compiled,
        "steps": measure_steps(options.scenes, options.steps, options.tries),
    }
    sys.stdout.write((json.dumps(found) if options.json else "\n".join(report_tables(found))) + "\n")
    if options.write_docs:
        (ROOT / "docs" / "reference" / "safety" / "kernel.md").write_text(render_page(found))
    return int(any(one["not_allowed"] or one["recursion"] or one["addresses_taken"] for one in compiled))


def parse(arguments: list[str]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="one JSON object on stdout")
    parser.add_argument("--write-docs", action="store_true", help="write docs/reference/safety/kernel.md")
    parser.add_argument(
        "--scenes", type=int, default=12, help="number of closed loops, each in its own scene (default 12)"
    )
    parser.add_argument("--steps", type=int, default=10_000, help="steps per loop (default 10000)")
    parser.add_argument(
        "--tries", type=int, default=3_000, help="random changes per start of the search (default 3000)"
    )
    return parser.parse_args(arguments)


def measure_steps(scenes: int, count: int, tries: int) -> dict[str, object]:
    """Return quantiles over all steps of all loops, the repeated worst steps, and the results of the search."""
    robot_model, rng = load_panda(), np.random.default_rng(0)
    measured, worst = [], []
    for seed in range(scenes):
        steps = list(adversarial_loop(robot_model, seed, count))
        measured += [(m.iterations, m.rows, m.seconds) for m in steps]
        worst += sorted(steps, key=lambda m: (m.iterations, m.rows))[-2:]
        worst += sorted(steps, key=lambda m: m.seconds)[-2:]
        print(f"scene {seed + 1}/{scenes}", file=sys.stderr, flush=True)
    iterations, rows, seconds = (np.array(column) for column in zip(*measured, strict=True))
    cold = [repeat_cold(make_filter(robot_model, m.scene), m, times=50) for m in worst]
    top = sorted(cold, key=lambda m: (m.iterations, m.rows))[-8:]
    hardest = search_worst_step(robot_model, top, rng, tries)
    program = search_worst_qp(rng, 20 * tries)
    return {
        "scenes": scenes,
        "steps": len(measured),
        "iterations": quantiles(iterations),
        "rows": quantiles(rows),
        "microseconds": quantiles(1e6 * seconds),
        "histogram": [int(np.sum(iterations == k)) for k in range(int(iterations.max()) + 1)],
        "repeated_microseconds": max(1e6 * m.seconds for m in cold),
        "hardest": {"iterations": hardest.iterations, "rows": hardest.rows, "microseconds": 1e6 * hardest.seconds},
        "program": {"iterations": program[0], "rows": program[1]},
        "cap": iteration_cap(),
        "most_rows": max_rows(),
    }


def quantiles(values: np.ndarray) -> dict[str, float]:
    """Return median, 99 % and 99.9 % quantiles, and maximum."""
    return {
        "median": float(np.median(values)),
        "p99": float(np.quantile(values, 0.99)),
        "p999": float(np.quantile(values, 0.999)),
        "max": float(values.max()),
    }


def iteration_cap() -> int:
    """Return DBK_QP_MAX_ITERATIONS; a step that reaches it brakes."""
    return _config_value("DBK_QP_MAX_ITERATIONS")


def max_rows() -> int:
    """Return DBK_MAX_ROWS."""
    return _config_value("DBK_MAX_ROWS")


def _config_value(name: str) -> int:
    lines = (ROOT / "kernel/include/dbk/dbk_config.h").read_text().splitlines()
    return next(int(line.split()[2]) for line in lines if line.startswith(f"#define {name} "))


if __name__ == "__main__":
    sys.exit(main())
