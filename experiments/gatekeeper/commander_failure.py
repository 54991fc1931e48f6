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

from dualbrain.control.gatekeeper.gatekeeper import BEAT_EVERY, SILENCE
from dualbrain.control.gatekeeper.protocol.server import FRAMES_A_SECOND, FRAMES_A_TICK
from dualbrain.control.gatekeeper.robot_link.simulated_robot import BEHIND, WATCHDOG
from dualbrain.evaluation.fault_injection.faults import FULL_SPEED, MOMENTS, PHASES
from dualbrain.safety.supervisor.actions import Rung
from dualbrain.safety.supervisor.timing import SIMULATED
from experiments.engine.experiment import Options, Row, Unit
from experiments.figures.tables import share, table
from experiments.gatekeeper.commander_testbed import Stage, gatekeeper, until
from experiments.gatekeeper.tick import await_report
from experiments.memory.crash_recovery import examine

HOW = ("kill", "stop", "flood", "rubbish", "gatekeeper")
ACKNOWLEDGEMENT = "between write and acknowledgement"
"""Here: the contract has left the cortex, and no answer has come."""
REPEATS = 4
STALL = SIMULATED.lost
TOLD = BEAT_EVERY + 2.0 * STALL
COUNTED = FRAMES_A_SECOND / FRAMES_A_TICK * SIMULATED.period
DECLARED = {
    "kill": TOLD, "stop": SILENCE + TOLD, "flood": 2.0 * COUNTED + STALL + TOLD, "rubbish": STALL + TOLD,
    "gatekeeper": WATCHDOG + BEHIND,
}  # fmt: skip
"""Until HOLD (or more) is told in a heartbeat, or the drive is off, at most [s]; why, stands at the top."""


class Cortex:
    """A robot outlives what commands it."""

    name = "commander_failure"
    claim = (
        "The cortex killed, stopped, flooding or talking rubbish, or the gatekeeper killed, at the worst moments of a "
        "contract: a safe state within the declared time, nothing unsafe, nothing lost in the ledger, and the next "
        "commander is welcome and its contract carried out."
    )

    def units(self, options: Options) -> list[Unit]:
        """4 times 5 ways × 6 moments."""
        del options
        return [
            Unit(f"{how}/{moment}/{again}", {"how": how, "moment": moment, "seed": again})
            for again in range(REPEATS) for moment in MOMENTS for how in HOW
        ]  # fmt: skip

    def run(self, about: dict[str, Any]) -> Row:
        """One contract that loses its commander."""
        with tempfile.TemporaryDirectory(prefix="dualbrain-") as name:
            folder = Path(name)
            stage = Stage(folder, gatekeeper(folder, "one"))
            try:
                found = _lose(stage, about["how"], about["moment"], about["seed"])
                found |= stage.serves_again(dead=about["how"] == "gatekeeper")
            finally:
                stage.leave()
            report = await_report(folder / "one.json")
            fault, missing = examine(folder / "ledger.sqlite", set(stage.stored))
        if about["how"] == "gatekeeper":
            found["took"] = report.off_at - found["at"] if report.off_at is not None else None
        until_then = inf if about["how"] == "gatekeeper" else found["next_at"]
        told = [one for one in report.judgement.violations if one.kind != "object_dropped"]
        unsafe = msgspec.to_builtins([one for one in told if one.start < until_then])
        ledger = {"stored": len(stage.stored), "missing": missing, "fault": fault}
        later = len(told) - len(unsafe)
        return {**about, **found, "unsafe": unsafe, "later": later, "travel": report.travel, "ledger": ledger}

    def brief(self, row: Row) -> str:
        """For the progress line."""
        took = "never" if row["took"] is None else f"{1e3 * row['took']:.0f} ms"
        ledger = row["ledger"]["fault"] or f"{row['ledger']['missing']} of {row['ledger']['stored']} lost"
        return f"{took}, the next {row['next']}, unsafe {len(row['unsafe'])}, ledger: {ledger}"

    def report(self, rows: list[Row]) -> list[str]:
        """Times by way and by moment, the ledger, the next commander, and whatever went wrong by name."""
        fair = [row for row in rows if not row["early"]]
        head = ("how", "episodes", "declared", "median", "99 %", "longest", "later than declared", "unsafe",
                "next contract")  # fmt: skip
        lines = table(head, (_line(how, fair) for how in HOW if any(row["how"] == how for row in fair)))
        head = ("longest, by moment", *HOW)
        lines += table(head, ((moment, *(_longest(fair, how, moment) for how in HOW)) for moment in MOMENTS))
        stored, missing = (sum(row["ledger"][name] for row in rows) for name in ("stored", "missing"))
        intact = sum(not (row["ledger"]["fault"] or row["ledger"]["missing"]) for row in rows)
        lines += [
            f"Ledger intact (chain valid, every acknowledged episode there, weights rebuilt equal, open to the next "
            f"writer): **{share(intact, len(rows))}**; {missing} of {stored} acknowledged episodes lost.",
        ]  # fmt: skip
        if later := sum(row["later"] > 0 for row in rows):
            lines += ["", f"Hands that touched, under the next contract, what they had been stopped around: {later}."]
        if early := len(rows) - len(fair):
            lines += ["", f"Not counted: {early} whose arm was held before the deed (the machine had no time for it)."]
        return ["", *lines, "", *(f"- {row['key']}: {self.brief(row)}; {row['unsafe']}" for row in fair if _bad(row))]


def _lose(stage: Stage, how: str, moment: str, seed: int) -> Row:
    """When the deed was done [s, monotonic], how long it took until HOLD, whether the arm was held before."""
    child = stage.begin(how, waits=moment != ACKNOWLEDGEMENT)
    wait = float(np.random.default_rng([seed, HOW.index(how), MOMENTS.index(moment)]).uniform(0.0, 0.1))
    if moment == ACKNOWLEDGEMENT:
        _say(child, "write")
        stage.await_line("written")
    else:
        fast = FULL_SPEED if moment == "closing" else 0.0
        until(moment, lambda: stage.phase in PHASES[moment] and stage.speed >= fast)
        time.sleep(wait)
    early, at = stage.order() >= Rung.HOLD, time.monotonic()
    if how == "gatekeeper":
        os.kill(stage.process.process.pid, signal.SIGKILL)
    elif how in ("kill", "stop"):
        os.kill(child.pid, signal.SIGKILL if how == "kill" else signal.SIGSTOP)
    else:
        _say(child, "go")
    took = None if how == "gatekeeper" else _until_hold(stage, at)
    return {"at": at, "wait": wait, "early": early, "took": took}


def _say(child: subprocess.Popen[str], word: str) -> None:
    if child.stdin:
        child.stdin.write(word + "\n")
        child.stdin.flush()


def _until_hold(stage: Stage, start: float) -> float | None:
    while time.monotonic() - start < 5.0:
        if stage.order() >= Rung.HOLD:
            return time.monotonic() - start
        time.sleep(0.001)
    return None


def _line(how: str, rows: list[Row]) -> tuple[object, ...]:
    group = [row for row in rows if row["how"] == how]
    times = [row["took"] for row in group if row["took"] is not None]
    quantiles = np.percentile(times, (50, 99, 100)) if times else (np.nan,) * 3
    told = [f"{1e3 * float(value):.0f} ms" for value in (DECLARED[how], *quantiles)]
    late = sum(row["took"] is None or row["took"] > DECLARED[how] for row in group)
    ends = Counter(row["next"] for row in group)
    following = ", ".join(f"{kind} {count}" for kind, count in ends.most_common())
    return (how, len(group), *told, late, sum(bool(row["unsafe"]) for row in group), following)


def _longest(rows: list[Row], how: str, moment: str) -> str:
    group = [row["took"] for row in rows if (row["how"], row["moment"]) == (how, moment)]
    return "–" if not group else "never" if None in group else f"{1e3 * max(group):.0f} ms"


def _bad(row: Row) -> bool:
    late = row["took"] is None or row["took"] > DECLARED[row["how"]]
    lost = bool(row["ledger"]["fault"] or row["ledger"]["missing"])
    return late or bool(row["unsafe"]) or row["next"] in ("refused", "not let in") or lost
