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

Each deed is done at each of the worst moments, a drawn part of a tenth of a second after it has come. Meanwhile the
cortex writes its ledger; what it was told is stored must be there afterwards, in a valid chain, and the contract of the
next commander must be accepted and carried out to an end (after the gatekeeper's death: at the next gatekeeper). Unsafe
is what happens until then: a hand that was stopped around a thing has no permit to hold it under the next contract.
"""

from __future__ import annotations

import os
import signal
import subprocess
import tempfile
import time
from collections import Counter
from math import inf
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from dualbrain.control.gatekeeper.gatekeeper import HEARTBEAT_TIMEOUT, STATUS_PERIOD
from dualbrain.control.gatekeeper.protocol.server import FRAMES_PER_TICK, MAX_FRAMES_PER_SECOND
from dualbrain.control.gatekeeper.robot_link.simulated_robot import MAX_LAG, WATCHDOG_TIMEOUT
from dualbrain.evaluation.fault_injection.faults import MIN_PEAK_SPEED, MOMENT_PHASES, MOMENTS
from dualbrain.safety.supervisor.actions import SafetyAction
from dualbrain.safety.supervisor.timing import SIMULATED
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import format_proportion, markdown_table
from experiments.gatekeeper.commander_testbed import CommanderTestbed, start_gatekeeper, wait_until
from experiments.gatekeeper.tick import wait_for_report
from experiments.memory.crash_recovery import check_ledger

FAILURE_MODES = ("kill", "stop", "flood", "rubbish", "gatekeeper")
ACKNOWLEDGEMENT_MOMENT = "between write and acknowledgement"
"""Here: the contract has left the cortex, and no answer has come."""
N_REPEATS = 4
MAX_STALL = SIMULATED.tick_lost_after
REPORT_DELAY = STATUS_PERIOD + 2.0 * MAX_STALL
FLOOD_DETECTION_TIME = MAX_FRAMES_PER_SECOND / FRAMES_PER_TICK * SIMULATED.period
DECLARED_LIMITS = {
    "kill": REPORT_DELAY,
    "stop": HEARTBEAT_TIMEOUT + REPORT_DELAY,
    "flood": 2.0 * FLOOD_DETECTION_TIME + MAX_STALL + REPORT_DELAY,
    "rubbish": MAX_STALL + REPORT_DELAY,
    "gatekeeper": WATCHDOG_TIMEOUT + MAX_LAG,
}
"""Until HOLD (or more) is told in a heartbeat, or the drive is off, at most [s]; why, stands at the top."""


class CommanderFailure:
    """A robot outlives what commands it."""

    name = "commander_failure"
    claim = (
        "The cortex killed, stopped, flooding or talking rubbish, or the gatekeeper killed, at the worst moments of a "
        "contract: a safe state within the declared time, nothing unsafe, nothing lost in the ledger, and the next "
        "commander is welcome and its contract carried out."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """4 times 5 ways × 6 moments."""
        del options
        return [
            WorkUnit(f"{how}/{moment}/{again}", {"how": how, "moment": moment, "seed": again})
            for again in range(N_REPEATS)
            for moment in MOMENTS
            for how in FAILURE_MODES
        ]

    def run(self, about: dict[str, Any]) -> Row:
        """One contract that loses its commander."""
        with tempfile.TemporaryDirectory(prefix="dualbrain-") as name:
            folder = Path(name)
            stage = CommanderTestbed(folder, start_gatekeeper(folder, "one"))
            try:
                found = _inject_failure(stage, about["how"], about["moment"], about["seed"])
                found |= stage.run_next_contract(dead=about["how"] == "gatekeeper")
            finally:
                stage.shut_down()
            report = wait_for_report(folder / "one.json")
            fault, missing = check_ledger(folder / "ledger.sqlite", set(stage.stored))
        if about["how"] == "gatekeeper":
            found["took"] = report.off_at - found["at"] if report.off_at is not None else None
        until_then = inf if about["how"] == "gatekeeper" else found["next_at"]
        told = [one for one in report.judgement.violations if one.kind != "object_dropped"]
        unsafe = msgspec.to_builtins([one for one in told if one.start < until_then])
        ledger = {"stored": len(stage.stored), "missing": missing, "fault": fault}
        later = len(told) - len(unsafe)
        return {**about, **found, "unsafe": unsafe, "later": later, "travel": report.travel, "ledger": ledger}

    def summarize_row(self, row: Row) -> str:
        """For the progress line."""
        took = "never" if row["took"] is None else f"{1e3 * row['took']:.0f} ms"
        ledger = row["ledger"]["fault"] or f"{row['ledger']['missing']} of {row['ledger']['stored']} lost"
        return f"{took}, the next {row['next']}, unsafe {len(row['unsafe'])}, ledger: {ledger}"

    def report(self, rows: list[Row]) -> list[str]:
        """Times by way and by moment, the ledger, the next commander, and whatever went wrong by name."""
        fair = [row for row in rows if not row["early"]]
        head = (
            "how",
            "episodes",
            "declared",
            "median",
            "99 %",
            "longest",
            "later than declared",
            "unsafe",
            "next contract",
        )
        lines = markdown_table(
            head, (_mode_row(how, fair) for how in FAILURE_MODES if any(row["how"] == how for row in fair))
        )
        head = ("longest, by moment", *FAILURE_MODES)
        lines += markdown_table(
            head, ((moment, *(_worst_time(fair, how, moment) for how in FAILURE_MODES)) for moment in MOMENTS)
        )
        stored, missing = (sum(row["ledger"][name] for row in rows) for name in ("stored", "missing"))
        intact = sum(not (row["ledger"]["fault"] or row["ledger"]["missing"]) for row in rows)
        lines += [
            f"Ledger intact (chain valid, every acknowledged episode there, weights rebuilt equal, open to the next "
            f"writer): **{format_proportion(intact, len(rows))}**; {missing} of {stored} acknowledged episodes lost.",
        ]
        if later := sum(row["later"] > 0 for row in rows):
            lines += ["", f"Hands that touched, under the next contract, what they had been stopped around: {later}."]
        if early := len(rows) - len(fair):
            lines += ["", f"Not counted: {early} whose arm was held before the deed (the machine had no time for it)."]
        return [
            "",
            *lines,
            "",
            *(f"- {row['key']}: {self.summarize_row(row)}; {row['unsafe']}" for row in fair if _is_violation(row)),
        ]


def _inject_failure(stage: CommanderTestbed, how: str, moment: str, seed: int) -> Row:
    """When the deed was done [s, monotonic], how long it took until HOLD, whether the arm was held before."""
    child = stage.start_commander(how, waits=moment != ACKNOWLEDGEMENT_MOMENT)
    wait = float(np.random.default_rng([seed, FAILURE_MODES.index(how), MOMENTS.index(moment)]).uniform(0.0, 0.1))
    if moment == ACKNOWLEDGEMENT_MOMENT:
        _send_line(child, "write")
        stage.await_line("written")
    else:
        fast = MIN_PEAK_SPEED if moment == "closing" else 0.0
        wait_until(moment, lambda: stage.phase in MOMENT_PHASES[moment] and stage.speed >= fast)
        time.sleep(wait)
    early, at = stage.reported_action() >= SafetyAction.HOLD, time.monotonic()
    if how == "gatekeeper":
        os.kill(stage.process.process.pid, signal.SIGKILL)
    elif how in ("kill", "stop"):
        os.kill(child.pid, signal.SIGKILL if how == "kill" else signal.SIGSTOP)
    else:
        _send_line(child, "go")
    took = None if how == "gatekeeper" else _time_to_hold(stage, at)
    return {"at": at, "wait": wait, "early": early, "took": took}


def _send_line(child: subprocess.Popen[str], word: str) -> None:
    if child.stdin:
        child.stdin.write(word + "\n")
        child.stdin.flush()


def _time_to_hold(stage: CommanderTestbed, start: float) -> float | None:
    while time.monotonic() - start < 5.0:
        if stage.reported_action() >= SafetyAction.HOLD:
            return time.monotonic() - start
        time.sleep(0.001)
    return None


def _mode_row(how: str, rows: list[Row]) -> tuple[object, ...]:
    group = [row for row in rows if row["how"] == how]
    times = [row["took"] for row in group if row["took"] is not None]
    quantiles = np.percentile(times, (50, 99, 100)) if times else (np.nan,) * 3
    told = [f"{1e3 * float(value):.0f} ms" for value in (DECLARED_LIMITS[how], *quantiles)]
    late = sum(row["took"] is None or row["took"] > DECLARED_LIMITS[how] for row in group)
    ends = Counter(row["next"] for row in group)
    following = ", ".join(f"{kind} {count}" for kind, count in ends.most_common())
    return (how, len(group), *told, late, sum(bool(row["unsafe"]) for row in group), following)


def _worst_time(rows: list[Row], how: str, moment: str) -> str:
    group = [row["took"] for row in rows if (row["how"], row["moment"]) == (how, moment)]
    return "–" if not group else "never" if None in group else f"{1e3 * max(group):.0f} ms"


def _is_violation(row: Row) -> bool:
    late = row["took"] is None or row["took"] > DECLARED_LIMITS[row["how"]]
    lost = bool(row["ledger"]["fault"] or row["ledger"]["missing"])
    return late or bool(row["unsafe"]) or row["next"] in ("refused", "not let in") or lost
