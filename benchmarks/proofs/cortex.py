"""The cortex killed, stopped, flooding, talking rubbish, and the gatekeeper killed: how long until the arm is safe.

The limits are sums of times that the code declares, never of times that were measured:

    told        a heartbeat each 50 ticks, and the two processes on the way (gatekeeper, watcher), each of which may
                stand still for `Timing.lost` before that is a fault of its own
    kill        told: a closed connection is seen in the next tick
    rubbish     told, and a stall of the cortex, which has to act first: the first broken frame is the last
    stop        SILENCE (a commander not heard for so long is silent), then told
    flood       the time in which FRAMES_A_SECOND are heard at FRAMES_A_TICK a tick, twice (the second that counts them
                may end in between), then as rubbish
    gatekeeper  WATCHDOG of the robot's own process, and BEHIND, by which that may lag before it lets time go
"""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dualbrain.runtime.gatekeeper.client import GatekeeperLink, LinkLost
from dualbrain.runtime.gatekeeper.door import FRAMES_A_SECOND, FRAMES_A_TICK
from dualbrain.runtime.gatekeeper.keeper import BEAT_EVERY, SILENCE
from dualbrain.runtime.gatekeeper.robot_process import BEHIND, WATCHDOG, Report
from dualbrain.runtime.gatekeeper.seals import open_keys
from dualbrain.runtime.gatekeeper.spawn import Plan, Process
from dualbrain.runtime.vocabulary import PLANNER
from dualbrain.safety.order import Rung
from dualbrain.safety.timing import SIMULATED
from dualbrain.world.catalogue import open_scene
from proofs.proof import Options, Row, Unit

HOW = ("kill", "stop", "flood", "rubbish", "gatekeeper")
MOMENTS = (0.3, 0.8, 1.5, 2.5, 4.0, 5.0, 6.5, 8.0)
"""Seconds after the contract began: approach, descent, grasp, carrying, lowering."""
STALL = SIMULATED.lost
TOLD = BEAT_EVERY * SIMULATED.period + 2.0 * STALL
COUNTED = FRAMES_A_SECOND / FRAMES_A_TICK * SIMULATED.period
DECLARED = {
    "kill": TOLD, "stop": SILENCE + TOLD, "flood": 2.0 * COUNTED + STALL + TOLD, "rubbish": STALL + TOLD,
    "gatekeeper": WATCHDOG + BEHIND,
}  # fmt: skip
"""Until HOLD (or more) is told in a heartbeat, or the drive is off, at most [s]; why, stands at the top."""
CHILD = Path(__file__).resolve().parents[2] / "tests" / "runtime" / "gatekeeper" / "cortex.py"


class Cortex:
    """A robot outlives what commands it."""

    name = "cortex"
    claim = (
        "The cortex killed, stopped, flooding or talking rubbish, or the gatekeeper killed, at any moment of a "
        "contract: a safe state within the declared time, nothing unsafe, and the next commander is welcome."
    )

    def units(self, options: Options) -> list[Unit]:
        """5 ways × 8 moments."""
        del options
        return [Unit(f"{how}/{at}", {"how": how, "at": at}) for at in MOMENTS for how in HOW]

    def run(self, about: dict[str, Any]) -> Row:
        """One contract that loses its commander."""
        how = about["how"]
        with tempfile.TemporaryDirectory() as name:
            folder = Path(name)
            plan = Plan(
                "panda", open_scene("bare:0"), str(folder / "s"), str(folder / "keys"), report=str(folder / "r.json")
            )
            process = Process(plan)
            try:
                took, again = _lose(folder, process, how, about["at"])
            finally:
                process.stop()
            deadline = time.monotonic() + 10.0
            while not (folder / "r.json").exists() and time.monotonic() < deadline:
                time.sleep(0.05)
            time.sleep(0.1)
            report = msgspec.json.decode((folder / "r.json").read_bytes(), type=Report)
        if how == "gatekeeper" and took is not None:
            took = report.off_at - took if report.off_at is not None else None
        unsafe = [one for one in msgspec.to_builtins(report.judgement.violations) if one["kind"] != "object_dropped"]
        return {"how": how, "took": took, "again": again, "unsafe": unsafe, "travel": report.travel}

    def brief(self, row: Row) -> str:
        """For the progress line."""
        return f"{row['how']}: {row['took']}, welcome again {row['again']}, unsafe {len(row['unsafe'])}"

    def report(self, rows: list[Row]) -> list[str]:
        """By way: times, and what went wrong."""
        head = "| how | episodes | declared | median | 99 % | longest | later than declared | unsafe | welcome again |"
        lines = [head, "|---" * 9 + "|"]
        for how in HOW:
            group = [row for row in rows if row["how"] == how]
            times = [row["took"] for row in group if row["took"] is not None]
            if not times:
                continue
            told = [1e3 * DECLARED[how], *(1e3 * float(value) for value in np.percentile(times, (50, 99, 100)))]
            late = sum(value > DECLARED[how] for value in times)
            wrong, welcome = (sum(bool(row[name]) for row in group) for name in ("unsafe", "again"))
            words = " | ".join(f"{value:.0f} ms" for value in told)
            lines.append(f"| {how} | {len(group)} | {words} | {late} | {wrong} | {welcome} |")
        return lines


def _lose(folder: Path, process: Process, how: str, at: float) -> tuple[float | None, bool]:
    """Seconds from the deed to HOLD, and whether another commander is taken; for a dead gatekeeper, when it died."""
    flags = ["-S"] if sys.flags.no_site else []
    watcher = GatekeeperLink(folder / "s")
    child = subprocess.Popen(
        [sys.executable, *flags, str(CHILD), str(folder / "s"), str(folder / "keys"), how], stdin=subprocess.PIPE,
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        if child.stdout is None or child.stdin is None or child.stdout.readline() != "running\n":
            raise RuntimeError("the commander did not start")
        time.sleep(at)
        start = time.monotonic()
        if how == "gatekeeper":
            os.kill(process.process.pid, signal.SIGKILL)
            return start, True
        if how in ("kill", "stop"):
            os.kill(child.pid, signal.SIGKILL if how == "kill" else signal.SIGSTOP)
        else:
            child.stdin.write("go\n")
            child.stdin.flush()
        took = _until_hold(watcher, start)
        return took, _welcome(folder)
    finally:
        child.kill()
        child.wait()
        watcher.close()


def _until_hold(watcher: GatekeeperLink, start: float) -> float | None:
    while time.monotonic() - start < 5.0:
        if watcher.beat and Rung[watcher.beat.action] >= Rung.HOLD:
            return time.monotonic() - start
        time.sleep(0.002)
    return None


def _welcome(folder: Path) -> bool:
    deadline = time.monotonic() + 3.0
    while time.monotonic() < deadline:
        try:
            GatekeeperLink(folder / "s", open_keys(folder / "keys"), PLANNER).close()
        except LinkLost:
            time.sleep(0.05)
        else:
            return True
    return False
