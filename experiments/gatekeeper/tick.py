"""The control tick in real time: a gatekeeper at 1 kHz for ten minutes with planner, recorder and live view running."""

from __future__ import annotations

import tempfile
import time
from collections import Counter
from pathlib import Path
from statistics import median
from typing import Any

import msgspec

from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.process import GatekeeperProcess
from dualbrain.control.gatekeeper.robot_link.simulated_robot import RobotReport
from dualbrain.control.gatekeeper.timing.histogram import N_BINS
from dualbrain.control.gatekeeper.timing.tick_profile import TICK_PARTS
from dualbrain.control.gatekeeper.timing.tick_timing import BIN_FRACTION, TickTimingSummary
from dualbrain.control.recording.channels import recording_state
from dualbrain.safety.supervisor.timing import SIMULATED
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.gatekeeper.load import run_load
from experiments.safety.closed_loop import describe_violations

MINUTES = 10
SCENE = "tabletop:1"
PLOT_PATH = "images/tick.png"
LAST_BIN_START = BIN_FRACTION * N_BINS * SIMULATED.period
"""The last bin of the intervals begins here [s]."""
REPORT_TIMEOUT_S = 10.0
"""How long the robot may take to write its report [s]."""


class TickTiming:
    """1 kHz, measured: intervals, work, latency, late ticks, lost periods, and what a tick is made of."""

    name = "tick"
    claim = (
        "Ten minutes of the control tick at 1 kHz in real time, in one piece, while a planner decides without a pause, "
        "contracts move the arm, the recorder writes and the live view is drawn: measured."
    )

    def units(self, options: Options) -> list[WorkUnit]:
        """One: a machine that does nothing else is wanted for it."""
        return [WorkUnit(f"{MINUTES} minutes", {"seconds": 60.0 * MINUTES, "planner": options.planner})]

    def run(self, about: dict[str, Any]) -> Row:
        """A working day of a gatekeeper."""
        with tempfile.TemporaryDirectory(prefix="dualbrain-") as name:
            folder = Path(name)
            recording, punctual, left = (folder / name for name in ("e.mcap", "punctuality.json", "robot.json"))
            plan = GatekeeperConfig(
                robot="panda",
                scene=open_scene(SCENE),
                socket=str(folder / "s"),
                keys=str(folder / "keys"),
                recording=str(recording),
                punctuality=str(punctual),
                report=str(left),
            )
            process = GatekeeperProcess(plan)
            try:
                day = run_load(plan, SCENE, about["planner"], about["seconds"], folder)
            finally:
                process.stop()
            report, found = wait_for_report(left), msgspec.json.decode(punctual.read_bytes(), type=TickTimingSummary)
            state = recording_state(recording)
            size = recording.stat().st_size
        violations = msgspec.to_builtins(report.judgement.violations)
        recorded = {"complete": state.complete, "dropped": state.dropped, "bytes": size}
        return {
            **msgspec.to_builtins(found),
            "bins": {str(k): count for k, count in enumerate(found.bins) if count},
            **vars(day),
            "planner": about["planner"],
            "slips": report.slips,
            "robot_ticks": report.ticks,
            "violations": violations,
            "recording": recorded,
        }

    def summarize_row(self, row: Row) -> str:
        """For the progress line."""
        return f"{row['ticks']} ticks, median {1e3 * row['interval'][0]:.2f} ms, longest {1e3 * row['interval'][3]:.1f}"

    def report(self, rows: list[Row]) -> list[str]:
        """How punctual, what it was made of, what went on meanwhile."""
        return [line for row in rows for line in _report_lines(row)]


def wait_for_report(path: Path) -> RobotReport:
    """The robot's report, once it is whole; raises `FileNotFoundError` or `DecodeError` if it never is."""
    deadline = time.monotonic() + REPORT_TIMEOUT_S
    while True:
        try:
            return msgspec.json.decode(path.read_bytes(), type=RobotReport)
        except (OSError, msgspec.DecodeError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)


def _report_lines(row: Row) -> list[str]:
    states, loops = row["robot_ticks"], row["parts"]["door"]["ticks"]
    beyond, longest = row["bins"].get(str(N_BINS - 1), 0), row["interval"][3]
    lost, late = states - loops, row["late"]
    lines = [
        f"In one run: **{states}** periods of the robot, **{loops}** control ticks; **{lost}** ticks missed "
        f"({lost / max(1, states):.2%}), {row['missed']} states lost on the way. Late ticks (over "
        f"{1e3 * SIMULATED.max_tick_time:g} ms of work): **{late}** ({late / max(1, loops):.2%}). Stalls of over "
        f"{1e3 * LAST_BIN_START:.0f} ms: **{beyond}**, the longest {1e3 * longest:.0f} ms. Physics fell behind the "
        f"clock {row['slips']} times.",
        "",
        f"![Intervals between states, and what a tick is made of]({PLOT_PATH})",
        "",
    ]
    head = ("", "median", "99 %", "99.9 %", "longest")
    lines += markdown_table(head, ((name, *_format_ms(row[name])) for name in ("interval", "work", "latency")))
    lines += [
        "Interval: from one joint state to the next, as they are taken in. Work: from a state to the end of its tick. "
        "Latency: from a state to the command that answers it. What the work is made of; own: the longest without what "
        "other threads and processes did meanwhile:",
        "",
    ]
    head = ("part of a tick", "what it is", "ticks that had it", "mean", "median", "99 %", "99.9 %", "longest", "own")
    return lines + markdown_table(head, _part_rows(row["parts"], loops)) + _background_lines(row)


def _part_rows(parts: dict[str, Any], loops: int):
    for name, what in TICK_PARTS.items():
        part = parts[name]
        if part["ticks"] and name != "wait":
            times = (part["mean"], *part["quantiles"])
            own = f"{1e6 * part['cpu'][3]:.0f} µs" if "cpu" in part else "–"
            yield (name, what, f"{part['ticks'] / loops:.1%}", *(f"{1e6 * value:.0f} µs" for value in times), own)


def _background_lines(row: Row) -> list[str]:
    decisions, recording = row["decisions"], row["recording"]
    pieces, size = row["page"]
    thought = f"{len(decisions)} decisions of `{row['planner']}`"
    thought += f" (median {median(decisions):.1f} s)" if decisions else ""
    contracts = ", ".join(f"{kind} {count}" for kind, count in sorted(row["contracts"].items()))
    outcomes = ", ".join(f"{kind} {count}" for kind, count in sorted(row["outcomes"].items()))
    whole = "complete" if recording["complete"] else f"{recording['dropped']} messages dropped"
    return [
        f"Meanwhile: {thought}; contracts: {contracts}; outcomes: {outcomes}{_outcome_reasons(row)}; recording of "
        f"{recording['bytes'] / 1e6:.0f} MB, {whole}; a page of the live view took {pieces} messages, "
        f"{size / 1e6:.1f} MB. Violations on truth: {describe_violations(row) or 'none'}.",
        "",
    ]


def _outcome_reasons(row: Row) -> str:
    """Why contracts ended, in the words of their outcomes; older rows do not tell."""
    why = "; ".join(f"{reason} ({count})" for reason, count in Counter(row.get("reasons", {})).most_common(3))
    return f" (most often: {why})" if why else ""


def _format_ms(values: list[float]) -> list[str]:
    return [f"{1e3 * value:.2f} ms" for value in values]
