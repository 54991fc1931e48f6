"""Time to a safe state after the commander or the gatekeeper fails.

The commander process is killed, suspended, made to flood the socket or to send malformed bytes, or the gatekeeper is
killed. The declared limits are sums of times that the code declares, not of measured times:

    report      a heartbeat is sent every 50 ticks, and each of the two processes on the way (gatekeeper, watcher) may
                stall for `Timing.tick_lost_after` before the stall itself is a fault
    kill        report: a closed connection is detected in the next tick
    rubbish     (malformed bytes) report, and one stall of the commander before it sends: the first malformed frame
                closes the connection
    stop        HEARTBEAT_TIMEOUT (a commander without a heartbeat for so long is lost), and report
    flood       twice the time in which MAX_FRAMES_PER_SECOND frames are read at FRAMES_PER_TICK per tick (the counting
                window may end in between), and the limit of malformed bytes
    gatekeeper  WATCHDOG_TIMEOUT of the robot process, and LAG_ALLOWANCE, by which the host may delay the robot process

Each failure is injected at each of the worst moments, after a random wait of up to 0.1 s. Meanwhile the commander
writes its ledger: every episode whose storage was acknowledged must be in it afterwards, with a valid hash chain. The
contract of the next commander must be accepted and executed to an end (after a killed gatekeeper: by the next
gatekeeper). Only violations before the next contract count as unsafe: a gripper that was stopped around an object has
no permission to hold it under the next contract.
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
from dualbrain.control.gatekeeper.robot_link.simulated_robot import WATCHDOG_TIMEOUT
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
"""Here: the commander has sent the contract and has not received an answer."""
N_REPEATS, N_THREAD_REPEATS = 4, 2
"""Episodes of each failure and moment, without and with a control thread."""
LAG_ALLOWANCE = 0.1
"""Time [s] by which the host may delay the robot process."""
MAX_STALL = SIMULATED.tick_lost_after
REPORT_DELAY = STATUS_PERIOD + 2.0 * MAX_STALL
FLOOD_DETECTION_TIME = MAX_FRAMES_PER_SECOND / FRAMES_PER_TICK * SIMULATED.period
DECLARED_LIMITS = {
    "kill": REPORT_DELAY,
    "stop": HEARTBEAT_TIMEOUT + REPORT_DELAY,
    "flood": 2.0 * FLOOD_DETECTION_TIME + MAX_STALL + REPORT_DELAY,
    "rubbish": MAX_STALL + REPORT_DELAY,
    "gatekeeper": WATCHDOG_TIMEOUT + LAG_ALLOWANCE,
}
"""Limit of the time until a heartbeat reports HOLD or more, or the drive is off [s] (see the module docstring)."""
MODE_NAMES = {"rubbish": "malformed bytes"}
"""Printed names of failure modes whose stored name differs."""


class CommanderFailure:
    """Safe state, intact ledger and a working successor after a failure of the commander or the gatekeeper."""

    name = "commander_failure"
    claim = (
        "The commander is killed, suspended, floods the socket or sends malformed bytes, or the gatekeeper is killed, "
        "at the worst moments of a contract: the robot reaches a safe state within the declared time, no violation "
        "occurs, the ledger loses no acknowledged episode, and the contract of the next commander is accepted and "
        "executed."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """5 failures × 6 moments, 4 times each, and twice each with a control thread."""
        del options
        loop = [
            WorkUnit(f"{how}/{moment}/{again}", {"how": how, "moment": moment, "seed": again})
            for again in range(N_REPEATS)
            for moment in MOMENTS
            for how in FAILURE_MODES
        ]
        thread = [
            WorkUnit(f"thread/{one.key}", {**one.parameters, "thread": True})
            for one in loop
            if one.parameters["seed"] < N_THREAD_REPEATS
        ]
        return [*loop, *thread]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Execute one contract during which the commander or the gatekeeper fails."""
        with tempfile.TemporaryDirectory(prefix="dualbrain-") as name:
            folder = Path(name)
            testbed = CommanderTestbed(
                folder=folder, process=start_gatekeeper(folder, "one", thread=parameters.get("thread", False))
            )
            try:
                found = _inject_failure(testbed, parameters["how"], parameters["moment"], parameters["seed"])
                found |= testbed.run_next_contract(dead=parameters["how"] == "gatekeeper")
            finally:
                testbed.shut_down()
            report = wait_for_report(folder / "one.json")
            fault, missing = check_ledger(folder / "ledger.sqlite", set(testbed.stored))
        if parameters["how"] == "gatekeeper":
            found["took"] = report.drive_off_at - found["at"] if report.drive_off_at is not None else None
        until_then = inf if parameters["how"] == "gatekeeper" else found["next_at"]
        violations = [one for one in report.judgement.violations if one.kind != "object_dropped"]
        unsafe = msgspec.to_builtins([one for one in violations if one.start < until_then])
        ledger = {"stored": len(testbed.stored), "missing": missing, "fault": fault}
        later = len(violations) - len(unsafe)
        return {**parameters, **found, "unsafe": unsafe, "later": later, "travel": report.travel, "ledger": ledger}

    def summarize_row(self, row: Row) -> str:
        """Summarize the row for the progress line."""
        took = "never" if row["took"] is None else f"{1e3 * row['took']:.0f} ms"
        ledger = row["ledger"]["fault"] or f"{row['ledger']['missing']} of {row['ledger']['stored']} lost"
        return f"{took}, next contract {row['next']}, unsafe {len(row['unsafe'])}, ledger: {ledger}"

    def report(self, rows: list[Row]) -> list[str]:
        """Report times by failure and moment, the ledger, the next contract, and each failed episode by name."""
        valid = [row for row in rows if not row["early"]]
        head = (
            "failure",
            "episodes",
            "declared limit",
            "median",
            "99 %",
            "longest",
            "above the limit",
            "unsafe",
            "next contract",
        )
        loop, thread = ([row for row in valid if row.get("thread", False) is used] for used in (False, True))
        lines = markdown_table(
            head,
            [
                *(_mode_row(how, loop) for how in FAILURE_MODES if any(row["how"] == how for row in loop)),
                *(_mode_row(how, thread) for how in FAILURE_MODES if any(row["how"] == how for row in thread)),
            ],
        )
        head = ("longest time by moment", *map(_mode_name, FAILURE_MODES))
        lines += markdown_table(
            head, ((moment, *(_worst_time(valid, how, moment) for how in FAILURE_MODES)) for moment in MOMENTS)
        )
        stored, missing = (sum(row["ledger"][name] for row in rows) for name in ("stored", "missing"))
        intact = sum(not (row["ledger"]["fault"] or row["ledger"]["missing"]) for row in rows)
        lines += [
            f"Ledger intact (valid hash chain, every acknowledged episode present, equal weights after a rebuild, "
            f"next writer can open it): **{format_proportion(intact, len(rows))}**; {missing} of {stored} acknowledged "
            "episodes lost.",
        ]
        if later := sum(row["later"] > 0 for row in rows):
            lines += [
                "",
                f"Grippers that touched, under the next contract, the object around which they were stopped: {later}.",
            ]
        if early := len(rows) - len(valid):
            lines += [
                "",
                f"Not counted: {early} in which the arm was held before the failure (the machine was too busy).",
            ]
        return [
            "",
            *lines,
            "",
            *(f"- {row['key']}: {self.summarize_row(row)}; {row['unsafe']}" for row in valid if _is_violation(row)),
        ]


def _inject_failure(testbed: CommanderTestbed, how: str, moment: str, seed: int) -> Row:
    """Return the time of the failure [s, monotonic], the time until HOLD [s], and whether the arm was held before."""
    child = testbed.start_commander(how, waits=moment != ACKNOWLEDGEMENT_MOMENT)
    wait = float(np.random.default_rng([seed, FAILURE_MODES.index(how), MOMENTS.index(moment)]).uniform(0.0, 0.1))
    if moment == ACKNOWLEDGEMENT_MOMENT:
        _send_line(child, "write")
        testbed.await_line("written")
    else:
        min_speed = MIN_PEAK_SPEED if moment == "closing" else 0.0
        wait_until(moment, lambda: testbed.phase in MOMENT_PHASES[moment] and testbed.speed >= min_speed)
        time.sleep(wait)
    early, at = testbed.reported_action() >= SafetyAction.HOLD, time.monotonic()
    if how == "gatekeeper":
        os.kill(testbed.process.process.pid, signal.SIGKILL)
    elif how in ("kill", "stop"):
        os.kill(child.pid, signal.SIGKILL if how == "kill" else signal.SIGSTOP)
    else:
        _send_line(child, "go")
    took = None if how == "gatekeeper" else _time_to_hold(testbed, at)
    return {"at": at, "wait": wait, "early": early, "took": took}


def _send_line(child: subprocess.Popen[str], word: str) -> None:
    if child.stdin:
        child.stdin.write(word + "\n")
        child.stdin.flush()


def _time_to_hold(testbed: CommanderTestbed, start: float) -> float | None:
    while time.monotonic() - start < 5.0:
        if testbed.reported_action() >= SafetyAction.HOLD:
            return time.monotonic() - start
        time.sleep(0.001)
    return None


def _mode_name(how: str) -> str:
    return MODE_NAMES.get(how, how)


def _mode_row(how: str, rows: list[Row]) -> tuple[object, ...]:
    group = [row for row in rows if row["how"] == how]
    times = [row["took"] for row in group if row["took"] is not None]
    quantiles = np.percentile(times, (50, 99, 100)) if times else (np.nan,) * 3
    cells = [f"{1e3 * float(value):.0f} ms" for value in (DECLARED_LIMITS[how], *quantiles)]
    late = sum(row["took"] is None or row["took"] > DECLARED_LIMITS[how] for row in group)
    ends = Counter(row["next"] for row in group)
    following = ", ".join(f"{kind} {count}" for kind, count in ends.most_common())
    name = f"{_mode_name(how)}, control thread" if rows[0].get("thread") else _mode_name(how)
    return (name, len(group), *cells, late, sum(bool(row["unsafe"]) for row in group), following)


def _worst_time(rows: list[Row], how: str, moment: str) -> str:
    group = [row["took"] for row in rows if (row["how"], row["moment"]) == (how, moment)]
    return "–" if not group else "never" if None in group else f"{1e3 * max(group):.0f} ms"


def _is_violation(row: Row) -> bool:
    late = row["took"] is None or row["took"] > DECLARED_LIMITS[row["how"]]
    lost = bool(row["ledger"]["fault"] or row["ledger"]["missing"])
    return late or bool(row["unsafe"]) or row["next"] in ("refused", "not let in") or lost
