"""The control tick in real time: a gatekeeper at 1 kHz for ten minutes with planner, recorder and live view running."""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from pathlib import Path
from statistics import median
from typing import Any

import msgspec

from dualbrain.control.gatekeeper.config import Plan
from dualbrain.control.gatekeeper.process import Process
from dualbrain.control.gatekeeper.robot_link.simulated_robot import Report
from dualbrain.control.gatekeeper.timing.histogram import BINS
from dualbrain.control.gatekeeper.timing.tick_profile import PARTS
from dualbrain.control.gatekeeper.timing.tick_timing import BIN, Punctuality
from dualbrain.control.recording.channels import recording_state
from dualbrain.safety.supervisor.timing import SIMULATED
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from experiments.engine.experiment import Options, Row, Unit
from experiments.figures.tables import table
from experiments.gatekeeper.load import work
from experiments.safety.closed_loop import violation_words

MINUTES = 10
SCENE = "tabletop:1"
PICTURE = "images/tick.png"
WIDEST = BIN * BINS * SIMULATED.period
"""The last bin of the intervals begins here [s]."""
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


def _account(row: Row) -> list[str]:
    states, loops = row["robot_ticks"], row["parts"]["door"]["ticks"]
    beyond, longest = row["bins"].get(str(BINS - 1), 0), row["interval"][3]
    lost, late = states - loops, row["late"]
    lines = [
        f"In one run: **{states}** periods of the robot, **{loops}** control ticks; **{lost}** ticks missed "
        f"({lost / max(1, states):.2%}), {row['missed']} states lost on the way. Late ticks (over "
        f"{1e3 * SIMULATED.overrun:g} ms of work): **{late}** ({late / max(1, loops):.2%}). Stalls of over "
        f"{1e3 * WIDEST:.0f} ms: **{beyond}**, the longest {1e3 * longest:.0f} ms. Physics fell behind the clock "
        f"{row['slips']} times.", "",
        f"![Intervals between states, and what a tick is made of]({PICTURE})", "",
    ]  # fmt: skip
    head = ("", "median", "99 %", "99.9 %", "longest")
    lines += table(head, ((name, *_milliseconds(row[name])) for name in ("interval", "work", "latency")))
    lines += [
        "Interval: from one joint state to the next, as they are taken in. Work: from a state to the end of its tick. "
        "Latency: from a state to the command that answers it. What the work is made of; own: the longest without what "
        "other threads and processes did meanwhile:", "",
    ]  # fmt: skip
    head = ("part of a tick", "what it is", "ticks that had it", "mean", "median", "99 %", "99.9 %", "longest", "own")
    return lines + table(head, _parts(row["parts"], loops)) + _meanwhile(row)


def _parts(parts: dict[str, Any], loops: int):
    for name, what in PARTS.items():
        part = parts[name]
        if part["ticks"] and name != "wait":
            times = (part["mean"], *part["quantiles"])
            own = f"{1e6 * part['cpu'][3]:.0f} µs" if "cpu" in part else "–"
            yield (name, what, f"{part['ticks'] / loops:.1%}", *(f"{1e6 * value:.0f} µs" for value in times), own)


def _meanwhile(row: Row) -> list[str]:
    decisions, recording = row["decisions"], row["recording"]
    pieces, size = row["page"]
    thought = f"{len(decisions)} decisions of `{row['planner']}`"
    thought += f" (median {median(decisions):.1f} s)" if decisions else ""
    contracts = ", ".join(f"{kind} {count}" for kind, count in sorted(row["contracts"].items()))
    outcomes = ", ".join(f"{kind} {count}" for kind, count in sorted(row["outcomes"].items()))
    whole = "complete" if recording["complete"] else f"{recording['dropped']} messages dropped"
    return [
        f"Meanwhile: {thought}; contracts: {contracts}; outcomes: {outcomes}{_why(row)}; recording of "
        f"{recording['bytes'] / 1e6:.0f} MB, {whole}; a page of the live view took {pieces} messages, "
        f"{size / 1e6:.1f} MB. Violations on truth: {violation_words(row) or 'none'}.", "",
    ]  # fmt: skip


def _why(row: Row) -> str:
    """Why contracts ended, in the words of their outcomes; older rows do not tell."""
    why = "; ".join(f"{reason} ({count})" for reason, count in Counter(row.get("reasons", {})).most_common(3))
    return f" (most often: {why})" if why else ""


def _milliseconds(values: list[float]) -> list[str]:
    return [f"{1e3 * value:.2f} ms" for value in values]
