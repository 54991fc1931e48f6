"""The control tick in real time: a gatekeeper at 1 kHz for ten minutes with planner, recorder and live view running."""

from __future__ import annotations

import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import msgspec

from dualbrain.runtime.gatekeeper.laps import PARTS
from dualbrain.runtime.gatekeeper.metronome import BIN, Punctuality
from dualbrain.runtime.gatekeeper.robot_process import Report
from dualbrain.runtime.gatekeeper.spawn import Plan, Process
from dualbrain.runtime.recording import recording_state
from dualbrain.safety.timing import SIMULATED
from dualbrain.world.catalogue import open_scene
from proofs.closed_loop import violation_words
from proofs.figures import table
from proofs.proof import Options, Row, Unit
from proofs.workday import work

MINUTES = 10
SCENE = "tabletop:1"
PICTURE = "images/tick.png"
LEAVE = 10.0
"""How long the robot may take to write its report [s]."""


class Tick:
    """1 kHz, measured: intervals, work, latency, late ticks, lost periods, and what a tick is made of."""

    name = "tick"
    claim = (
        "Ten minutes of the control tick at 1 kHz in real time, in one piece, while a planner decides without a pause, "
        "contracts move the arm, the recorder writes and the live view is drawn: measured."
    )

    def units(self, options: Options) -> list[Unit]:
        """One: a machine that does nothing else is wanted for it."""
        return [Unit(f"{MINUTES} minutes", {"seconds": 60.0 * MINUTES, "planner": options.planner})]

    def run(self, about: dict[str, Any]) -> Row:
        """A working day of a gatekeeper."""
        with tempfile.TemporaryDirectory(prefix="dualbrain-") as name:
            folder = Path(name)
            recording, punctual, left = (folder / name for name in ("e.mcap", "punctuality.json", "robot.json"))
            plan = Plan(
                "panda", open_scene(SCENE), str(folder / "s"), str(folder / "keys"), recording=str(recording),
                punctuality=str(punctual), report=str(left),
            )  # fmt: skip
            process = Process(plan)
            try:
                day = work(plan, SCENE, about["planner"], about["seconds"], folder)
            finally:
                process.stop()
            report, found = await_report(left), msgspec.json.decode(punctual.read_bytes(), type=Punctuality)
            state = recording_state(recording)
            size = recording.stat().st_size
        violations = msgspec.to_builtins(report.judgement.violations)
        recorded = {"complete": state.complete, "dropped": state.dropped, "bytes": size}
        return {
            **msgspec.to_builtins(found), "bins": {str(k): count for k, count in enumerate(found.bins) if count},
            **vars(day), "planner": about["planner"], "slips": report.slips, "robot_ticks": report.ticks,
            "violations": violations, "recording": recorded,
        }  # fmt: skip

    def brief(self, row: Row) -> str:
        """For the progress line."""
        return f"{row['ticks']} ticks, median {1e3 * row['interval'][0]:.2f} ms, longest {1e3 * row['interval'][3]:.1f}"

    def report(self, rows: list[Row]) -> list[str]:
        """How punctual, what it was made of, what went on meanwhile."""
        return [line for row in rows for line in _account(row)]


def await_report(path: Path) -> Report:
    """The robot's report, once it is whole; raises `FileNotFoundError` or `DecodeError` if it never is."""
    deadline = time.monotonic() + LEAVE
    while True:
        try:
            return msgspec.json.decode(path.read_bytes(), type=Report)
        except (OSError, msgspec.DecodeError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)


def lost_periods(bins: dict[str, int], longest: float) -> int:
    """How many periods no tick began in: an interval of k periods (rounded) has lost k − 1."""
    last = max(map(int, bins), default=0)
    middles = ((longest if int(k) == last else BIN * (int(k) + 0.5), count) for k, count in bins.items())
    return sum(max(0, round(middle / SIMULATED.period) - 1) * count for middle, count in middles)


def _account(row: Row) -> list[str]:
    ticks, longest = row["ticks"], row["interval"][3]
    lost, late, states = lost_periods(row["bins"], longest), row["late"], row["missed"]
    lines = [
        f"**{ticks}** ticks in one run. States of the robot that never came: **{states}**. Periods in which no tick "
        f"began: **{lost}** ({lost / max(1, ticks):.3%}). Late ticks (over {1e3 * SIMULATED.overrun:g} ms of work): "
        f"**{late}** ({late / max(1, ticks):.3%}). Physics fell behind the clock {row['slips']} times.", "",
        f"![Intervals between ticks, and what a tick is made of]({PICTURE})", "",
    ]  # fmt: skip
    head = ("", "median", "99 %", "99.9 %", "longest")
    lines += table(head, ((name, *_milliseconds(row[name])) for name in ("interval", "work", "latency")))
    lines += [
        "Interval: from one joint state to the next. Work: from a state to the end of its tick. Latency: from a state "
        "to the command that answers it. What the work is made of:", "",
    ]  # fmt: skip
    head = ("part of a tick", "what it is", "ticks that had it", "mean", "median", "99 %", "99.9 %", "longest")
    return lines + table(head, _parts(row["parts"])) + _meanwhile(row)


def _parts(parts: dict[str, Any]):
    for name, what in PARTS.items():
        part = parts[name]
        if part["ticks"] and name != "wait":
            times = (part["mean"], *part["quantiles"])
            yield (name, what, part["ticks"], *(f"{1e6 * value:.0f} µs" for value in times))


def _meanwhile(row: Row) -> list[str]:
    decisions, recording = row["decisions"], row["recording"]
    pieces, size = row["page"]
    thought = f"{len(decisions)} decisions of `{row['planner']}`"
    thought += f" (median {median(decisions):.1f} s)" if decisions else ""
    contracts = ", ".join(f"{kind} {count}" for kind, count in sorted(row["contracts"].items()))
    outcomes = ", ".join(f"{kind} {count}" for kind, count in sorted(row["outcomes"].items()))
    whole = "complete" if recording["complete"] else f"{recording['dropped']} messages dropped"
    return [
        f"Meanwhile: {thought}; contracts: {contracts}; outcomes: {outcomes}; recording of "
        f"{recording['bytes'] / 1e6:.0f} MB, {whole}; a page of the live view took {pieces} messages, "
        f"{size / 1e6:.1f} MB. Violations on truth: {violation_words(row) or 'none'}.", "",
    ]  # fmt: skip


def _milliseconds(values: list[float]) -> list[str]:
    return [f"{1e3 * value:.2f} ms" for value in values]
