"""Punctuality of the control thread in C at 1 kHz under load, beside the same tick in Python in the same run."""

from __future__ import annotations

import multiprocessing
import os
import tempfile
import time
from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path
from statistics import median
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Pose, Sphere
from dualbrain.robots.interface import RobotState
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import Obstacle, SafetyFilter
from dualbrain.safety.control_thread import ControlThread, ControlThreadConfig
from dualbrain.safety.supervisor.controller import SafetyController
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.gatekeeper.thread_timing.empty_thread import run_cyclictest

UNIT_S, N_ROUNDS, OTHER_ROUNDS = 60.0, 10, 3
"""Duration of a unit [s]; units with SCHED_FIFO, and of each other variant."""
PERIOD_S, LATE_US = 0.001, 200
PRIORITY = 80
VARIANTS = {
    "fifo": "C thread, SCHED_FIFO",
    "empty": "`cyclictest`: a thread that does nothing, SCHED_FIFO",
    "ordinary": "C thread, ordinary priority",
    "python": "`SafetyController` in Python, ordinary priority",
}
REAL_TIME = ("fifo", "empty")
INPUT_PAUSE_S = 0.01
"""Pause of the Python side between two nominal controls [s]."""
N_OBSTACLES, N_BUSY = 12, 2

Times = NDArray[np.float64]


class ControlThreadTiming:
    """Late and skipped periods of four variants, in turns."""

    name = "control_thread"
    claim = (
        "Over ten minutes at 1 kHz beside two busy processes and a recorder, the control thread in C with SCHED_FIFO "
        "begins no tick more than 0.2 ms late. The values of an empty thread, without SCHED_FIFO and of the tick in "
        "Python are beside it."
    )
    intervals = "least and most of the units"

    def units(self, options: Options) -> list[WorkUnit]:
        """Ten minutes of each thread with SCHED_FIFO and three of each other variant; they need an idle machine."""
        del options
        rounds = [(number, variant) for number in range(N_ROUNDS) for variant in VARIANTS]
        return [
            WorkUnit(f"{variant} {number}", {"variant": variant})
            for number, variant in rounds
            if variant in REAL_TIME or number < OTHER_ROUNDS
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """One minute of a variant."""
        variant = parameters["variant"]
        with _busy_processes():
            if variant == "python":
                found = run_python()
            elif variant == "empty":
                found = run_cyclictest(UNIT_S, round(1e6 * PERIOD_S), PRIORITY, LATE_US)
            else:
                found = run_thread(PRIORITY if variant == "fifo" else 0)
        return {"variant": variant, **found}

    def summarize_row(self, row: Row) -> str:
        """The late and skipped periods."""
        return (
            f"{row['late']} of {row['ticks']} ticks late, {row['skipped']} periods skipped, at most {row['max_us']} µs"
        )

    def report(self, rows: list[Row]) -> list[str]:
        """One line for each variant."""
        heads = ("variant", "minutes", "ticks", "late > 0.2 ms", "share by minute", "periods without a tick")
        heads += ("of them before a tick began", "median [µs]", "99.9 % [µs]", "longest [µs]", "longest tick [µs]")
        body = [_table_row(title, [row for row in rows if row["variant"] == name]) for name, title in VARIANTS.items()]
        late, empty = (sum(row["late"] for row in rows if row["variant"] == name) for name in REAL_TIME)
        verdict = (
            f"The claim does **not** hold on this machine: {late} ticks were late. An empty thread was late in "
            f"{empty} periods."
            if late
            else "No tick was late."
        )
        refused = sum(not row["real_time"] for row in rows if row["variant"] == "fifo")
        notes = [
            "Delays are those of the begin of a tick after its time; median and 99.9 % are medians of the minutes."
        ]
        notes += [f"SCHED_FIFO was refused in {refused} units."] if refused else []
        return [verdict, "", *markdown_table(heads, [row for row in body if row]), *notes]


def _table_row(title: str, rows: list[Row]) -> tuple[str, ...]:
    if not rows:
        return ()
    shares = [row["late"] / row["ticks"] for row in rows]
    ticks, late = (sum(row[name] for row in rows) for name in ("ticks", "late"))
    return (
        title,
        str(len(rows)),
        str(ticks),
        str(late),
        f"{median(shares):.3%} [{min(shares):.3%}, {max(shares):.3%}]",
        str(sum(row["skipped"] for row in rows)),
        str(sum(row["skipped_before"] for row in rows)) if "skipped_before" in rows[0] else "–",
        f"{median(row['p50_us'] for row in rows):.0f}",
        f"{median(row['p999_us'] for row in rows):.0f}",
        f"{max(row['max_us'] for row in rows):.0f}",
        f"{max(row['max_work_us'] for row in rows):.0f}" if "max_work_us" in rows[0] else "–",
    )


def run_thread(priority: int) -> Row:
    """One unit of the thread in C; its log is written to a file, and its inputs come from Python."""
    safety = _filter_with_obstacles()
    home = safety.robot_model.home
    thread = ControlThread(safety, ControlThreadConfig(priority=priority, lock_process=True), simulated_at=home)
    rng, control = np.random.default_rng(1), np.zeros(safety.robot_model.n)
    late, work = list[Times](), list[Times]()
    with tempfile.TemporaryFile() as recording, thread:
        end, count = time.monotonic() + UNIT_S, 0
        while time.monotonic() < end:
            if count % 50 == 0:
                control = rng.uniform(-0.5, 0.5, len(control))
            thread.submit_control(control)
            safety.observe(_obstacles(), time.monotonic())
            thread.submit_scene()
            log = thread.read_log()
            recording.write(log.tobytes())
            late.append(log["wake_late_us"].astype(float))
            work.append(log["work_us"].astype(float))
            count += 1
            time.sleep(INPUT_PAUSE_S)
        status = thread.status()
    summary = _summary(np.concatenate(late), np.concatenate(work), status.skipped)
    return {**summary, "real_time": status.real_time, "memory_lock": status.memory_lock, "dropped": status.log_dropped}


def run_python() -> Row:
    """One unit of the tick in Python, with the joint state of a robot at rest; periods that it misses are skipped."""
    safety = _filter_with_obstacles()
    controller, model = SafetyController(safety), safety.robot_model
    q, rest = np.array(model.home), np.zeros(model.n)
    late, work, skipped, sequence = list[float](), list[float](), 0, 0
    due = time.monotonic() + PERIOD_S
    end = due + UNIT_S
    while due < end:
        time.sleep(max(0.0, due - time.monotonic()))
        now = time.monotonic()
        sequence += 1
        state = RobotState(stamp=now, sequence=sequence, q=q, v=rest, opening=None, finger_forces=(0.0, 0.0))
        controller.accept_state(state, now)
        controller.decide(state, now)
        controller.control(state, rest, now)
        done = time.monotonic()
        late.append(1e6 * (now - due))
        work.append(1e6 * (done - now))
        missed = max(0, int((done - due) / PERIOD_S))
        skipped, due = skipped + missed, due + (missed + 1) * PERIOD_S
    return {**_summary(np.array(late), np.array(work), skipped), "real_time": False}


def _summary(late: Times, work: Times, skipped: int) -> Row:
    """Counts and quantiles; `skipped_before` are periods that had passed before a tick began, not during its work."""
    p50, p999 = np.percentile(late, (50, 99.9))
    return {
        "ticks": len(late),
        "late": int((late > LATE_US).sum()),
        "skipped": skipped,
        "skipped_before": int((late // (1e6 * PERIOD_S)).sum()),
        "p50_us": round(float(p50), 1),
        "p999_us": round(float(p999), 1),
        "max_us": round(float(late.max()), 1),
        "max_work_us": round(float(work.max()), 1),
    }


def _filter_with_obstacles() -> SafetyFilter:
    """The filter of a Panda without force sensing, among twelve spheres."""
    safety = SafetyFilter(msgspec.structs.replace(load_robot("panda"), force_sensing=None))
    safety.observe(_obstacles(), time.monotonic())
    return safety


def _obstacles() -> list[Obstacle]:
    return [Obstacle(f"ball {i}", Sphere(0.05), Pose((0.6, 0.1 * i - 0.6, 0.5))) for i in range(N_OBSTACLES)]


@contextmanager
def _busy_processes() -> Generator[None]:
    """In the body, two processes multiply matrices and write files without a pause."""
    context = multiprocessing.get_context("spawn")
    processes = [context.Process(target=_work_for_ever, args=(os.getpid(),), daemon=True) for _ in range(N_BUSY)]
    for process in processes:
        process.start()
    time.sleep(2.0)  # they have imported NumPy
    try:
        yield
    finally:
        for process in processes:
            process.kill()
            process.join()


def _work_for_ever(parent: int) -> None:
    """Ends with its `parent`."""
    matrix = np.eye(300)
    with tempfile.TemporaryDirectory() as folder:
        while os.getppid() == parent:
            for _ in range(100):
                matrix = matrix @ matrix
            (Path(folder) / "load").write_bytes(matrix.tobytes())
