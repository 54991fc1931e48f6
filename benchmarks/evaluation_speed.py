"""How fast the evaluation is: episodes an hour and core, where their time goes, and what a second process brings.

    python benchmarks/evaluation_speed.py [--episodes 12] [--jobs 1 2] [--method B3]

The same episodes (planner `template`, clutter grasp) are flown anew with each number of processes; the first of every
process is not counted, for it pays for the imports. Tables go to stdout. A machine that does something else besides
says so by its load, which stands beside the figures.
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

from dualbrain.cli.common import paths
from dualbrain.evaluation.episodes.case_runner import WALL_TIME_PARTS
from dualbrain.evaluation.planners.factory import PlannerSources
from dualbrain.evaluation.protocol.suite import Suite, load_suite
from dualbrain.evaluation.results.episode_row import EpisodeRow
from dualbrain.evaluation.runner.runner import Runner, StageProgress, parse_rows
from dualbrain.evaluation.runner.worker import WorkerConfig
from dualbrain.evaluation.runner.worker_pool import ProcessPool
from experiments.engine.provenance import machine, revision
from experiments.figures.tables import markdown_table

ROOT = Path(__file__).resolve().parents[1]


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--episodes", type=int, default=12)
    parser.add_argument("--jobs", type=int, nargs="+", default=[1, 2])
    parser.add_argument("--method", default="B3")
    asked = parser.parse_args()
    suite = msgspec.structs.replace(
        load_suite("smoke"), methods=(asked.method,), seeds=asked.episodes, repetitions=1, runs=1
    )
    found = {jobs: measure_rate(suite, jobs) for jobs in asked.jobs}
    print("\n".join(report_lines(found)))
    return 0


def measure_rate(suite: Suite, jobs: int) -> dict[str, Any]:
    """Fly the whole suite with `jobs` processes; the rate is that of the episodes after the first of each."""
    ends: list[float] = []

    def tell(progress: StageProgress) -> None:
        ends.append(time.monotonic())
        sys.stderr.write(f"{jobs} processes: {progress.done}/{progress.total} {progress.error}\n")

    with tempfile.TemporaryDirectory(prefix="dualbrain-speed-") as folder:
        out = Path(folder)
        runner = Runner(suite, out, clock=time.monotonic, on_progress=tell)
        place = WorkerConfig(
            suite=suite,
            out=out,
            sources=PlannerSources(paths.cache_folder(), out / "adapters"),
            clock=time.perf_counter,
            epsilon=runner.epsilon(),
        )
        load = os.getloadavg()[0]
        runner.run_stage("fly", ProcessPool(place.make_worker, jobs))
        rows = parse_rows(runner.log("fly").read())
    counted = len(ends) - jobs
    return {"rows": rows, "rate": counted / (ends[-1] - ends[jobs - 1]), "load": load, "counted": counted}


def report_lines(found: dict[int, dict[str, Any]]) -> list[str]:
    """Rates, shares of time, and the gain over one process."""
    head = (
        "processes",
        "episodes",
        "episodes an hour",
        "an hour and core",
        "gain",
        "simulated s per s",
        *WALL_TIME_PARTS,
        "load",
    )
    base = found[min(found)]["rate"]
    cells: list[tuple[object, ...]] = []
    for jobs, one in found.items():
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
    return [f"Revision {revision(ROOT)}; {machine()}.", "", *markdown_table(head, cells)]


if __name__ == "__main__":
    sys.exit(main())
