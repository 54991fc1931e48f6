"""Speed of the evaluation: episodes per hour and core, parts of their wall time, and gain of further processes.

    python -m benchmarks.evaluation_speed [--episodes 12] [--jobs 1 2] [--method B3]

The same episodes (planner `template`, clutter grasp) run with each number of processes. The first episode of each
process includes the imports and is not counted. The table is printed on stdout, with the load of the machine.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import msgspec

from dualbrain.core import paths
from dualbrain.evaluation.episodes.case_runner import WALL_TIME_PARTS
from dualbrain.evaluation.planners.factory import PlannerSources
from dualbrain.evaluation.protocol.suite import Suite, load_suite
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.evaluation.runner.provenance import git_revision, machine_description
from dualbrain.evaluation.runner.runner import Runner, StageProgress, parse_rows
from dualbrain.evaluation.runner.worker import WorkerConfig
from dualbrain.evaluation.runner.worker_pool import ProcessPool
from experiments.figures.tables import markdown_table

ROOT = Path(__file__).resolve().parents[1]
FOLDERS = ("src", "benchmarks")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=12)
    parser.add_argument("--jobs", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--method", default="B3")
    options = parser.parse_args()
    suite = msgspec.structs.replace(
        load_suite("smoke"), methods=(options.method,), seeds=options.episodes, repetitions=1, runs=1
    )
    measurements = {jobs: measure_rate(suite, jobs) for jobs in options.jobs}
    print("\n".join(report_lines(measurements)))
    return 0


def measure_rate(suite: Suite, jobs: int) -> dict[str, Any]:
    """Run the suite with `jobs` processes; the rate excludes the first episode of each process."""
    ends: list[float] = []

    def report_progress(progress: StageProgress) -> None:
        ends.append(time.monotonic())
        sys.stderr.write(f"{jobs} processes: {progress.done}/{progress.total} {progress.error}\n")

    with tempfile.TemporaryDirectory(prefix="dualbrain-speed-") as folder:
        out = Path(folder)
        runner = Runner(suite, out, clock=time.monotonic, on_progress=report_progress)
        worker_config = WorkerConfig(
            suite=suite,
            out=out,
            sources=PlannerSources(paths.cache_folder(), out / "adapters"),
            clock=time.perf_counter,
            epsilon=runner.epsilon(),
        )
        load = os.getloadavg()[0]
        runner.run_stage("fly", ProcessPool(worker_config.make_worker, jobs))
        rows = parse_rows(runner.log("fly").read())
    counted = len(ends) - jobs
    return {"rows": rows, "rate": counted / (ends[-1] - ends[jobs - 1]), "load": load, "counted": counted}


def report_lines(measurements: dict[int, dict[str, Any]]) -> list[str]:
    """Return a table of rates, shares of wall time, and the gain over the smallest number of processes."""
    head = (
        "processes",
        "episodes",
        "episodes per hour",
        "per hour and core",
        "gain",
        "simulated s per s",
        *WALL_TIME_PARTS,
        "load",
    )
    base = measurements[min(measurements)]["rate"]
    cells: list[tuple[object, ...]] = []
    for jobs, one in measurements.items():
        rows: list[EpisodeRow] = one["rows"]
        wall = sum(row.wall_s for row in rows)
        shares = [f"{sum(row.wall[part] for row in rows) / wall:.1%}" for part in WALL_TIME_PARTS]
        hourly = 3600.0 * one["rate"]
        pace = f"{sum(row.simulated_s for row in rows) / wall:.2f}"
        cells.append(
            (
                jobs,
                one["counted"],
                f"{hourly:.0f}",
                f"{hourly / jobs:.0f}",
                f"{one['rate'] / base:.2f}",
                pace,
                *shares,
                f"{one['load']:.1f}",
            )
        )
    return [
        f"Revision {git_revision(ROOT / 'benchmarks', FOLDERS)}; {machine_description()}.",
        "",
        *markdown_table(head, cells),
    ]


if __name__ == "__main__":
    sys.exit(main())
