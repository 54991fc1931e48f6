"""Timing of commands at 1 kHz: a gatekeeper with and without a control thread, beside planner, recorder and view."""

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
from dualbrain.safety.control_thread import ControlThreadConfig
from dualbrain.safety.supervisor.timing import SIMULATED
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.gatekeeper.load import run_load
from experiments.safety.closed_loop import describe_violations

N_ROUNDS, MINUTES = 4, 2.5
"""Rounds, and minutes of each variant in a round."""
VARIANTS = {"loop": "loop in Python", "thread": "control thread in C"}
SCENE = "tabletop:1"
LAST_BIN_START = BIN_FRACTION * N_BINS * SIMULATED.period
"""Start of the last bin of the interval histogram [s]."""
REPORT_TIMEOUT_S = 10.0
"""Time within which the robot process must write its report [s]."""


class TickTiming:
    """Periods of the robot without a command, late ticks, and parts of a tick at 1 kHz, of two variants in turns."""

    name = "tick"
    claim = (
        "Over ten minutes in real time at 1 kHz, while a planner generates without a pause, contracts move the arm, "
        "the recorder writes and the live view is updated, a robot behind the control thread in C misses fewer "
        "commands than one behind the loop in Python."
    )
    intervals = "least and most of the rounds"

    def units(self, options: Options) -> list[WorkUnit]:
        """Return both variants in turns; they need an otherwise idle machine."""
        return [
            WorkUnit(f"{variant} {number}", {"variant": variant, "seconds": 60.0 * MINUTES, "planner": options.planner})
            for number in range(N_ROUNDS)
            for variant in VARIANTS
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Run a gatekeeper under load and collect its timing."""
        with tempfile.TemporaryDirectory(prefix="dualbrain-") as name:
            folder = Path(name)
            recording, timing, robot_report = (folder / name for name in ("e.mcap", "punctuality.json", "robot.json"))
            config = GatekeeperConfig(
                robot="panda",
                scene=open_scene(SCENE),
                socket=str(folder / "s"),
                keys=str(folder / "keys"),
                recording=str(recording),
                tick_timing=str(timing),
                report=str(robot_report),
                control_thread=parameters["variant"] == "thread",
            )
            process = GatekeeperProcess(config)
            try:
                summary = run_load(config, SCENE, parameters["planner"], parameters["seconds"], folder)
            finally:
                process.stop()
            report = wait_for_report(robot_report)
            found = msgspec.json.decode(timing.read_bytes(), type=TickTimingSummary)
            state = recording_state(recording)
            size = recording.stat().st_size
        violations = msgspec.to_builtins(report.judgement.violations)
        recorded = {"complete": state.complete, "dropped": state.dropped, "bytes": size}
        return {
            **msgspec.to_builtins(found),
            "bins": {str(k): count for k, count in enumerate(found.bins) if count},
            **vars(summary),
            "planner": parameters["planner"],
            "variant": parameters["variant"],
            "slips": report.resynchronizations,
            "silent_periods": report.silent_periods,
            "longest_silence": report.longest_silence,
            "robot_ticks": report.ticks,
            "violations": violations,
            "recording": recorded,
        }

    def summarize_row(self, row: Row) -> str:
        """Summarize the row for the progress line."""
        silence = f"at most {1e3 * row['longest_silence']:.1f} ms between two commands"
        return f"{row['silent_periods']} of {row['robot_ticks']} periods without a command, {silence}"

    def report(self, rows: list[Row]) -> list[str]:
        """Report the periods without a command by variant; then the timing of the loop, its parts, and the load."""
        head = ("joints moved by the", "minutes", "periods", "without a command", "share by round")
        head += ("longest time between commands", "late ticks of the loop", "longest tick of the thread", "violations")
        groups = {name: [row for row in rows if row["variant"] == name] for name in VARIANTS}
        lines = markdown_table(head, (_variant_row(name, group) for name, group in groups.items() if group))
        lines += [
            "A period of the robot is without a command if none arrives between two of its states; the arm then "
            "continues with the last one. The loop in Python runs in both variants.",
            "",
        ]
        for name, group in groups.items():
            if group:
                lines += [f"Last round of the {VARIANTS[name]}:", "", *_report_lines(group[-1])]
        return lines


def _variant_row(name: str, rows: list[Row]) -> tuple[str, ...]:
    periods, silent = (sum(row[key] for row in rows) for key in ("robot_ticks", "silent_periods"))
    shares = [row["silent_periods"] / row["robot_ticks"] for row in rows]
    late, ticks = sum(row["late"] for row in rows), sum(row["ticks"] for row in rows)
    threads = [row["control_thread"]["max_work"] for row in rows if row["control_thread"]]
    return (
        VARIANTS[name],
        f"{len(rows) * MINUTES:g}",
        str(periods),
        str(silent),
        f"{silent / periods:.3%} [{min(shares):.3%}, {max(shares):.3%}]",
        f"{1e3 * max(row['longest_silence'] for row in rows):.1f} ms",
        f"{late / max(1, ticks):.2%}",
        f"{1e3 * max(threads):.2f} ms" if threads else "–",
        str(sum(len(row["violations"]) for row in rows)),
    )


def wait_for_report(path: Path) -> RobotReport:
    """Return the report of the robot process once it is complete.

    Raises `FileNotFoundError` or `msgspec.DecodeError` if it is not complete within REPORT_TIMEOUT_S.
    """
    deadline = time.monotonic() + REPORT_TIMEOUT_S
    while True:
        try:
            return msgspec.json.decode(path.read_bytes(), type=RobotReport)
        except (OSError, msgspec.DecodeError):
            if time.monotonic() > deadline:
                raise
            time.sleep(0.05)


def _report_lines(row: Row) -> list[str]:
    states, ticks = row["robot_ticks"], row["parts"]["door"]["ticks"]
    n_stalls, longest = row["bins"].get(str(N_BINS - 1), 0), row["interval"][3]
    lost, late = states - ticks, row["late"]
    lines = [
        f"**{states}** periods of the robot, **{ticks}** ticks of the loop; **{lost}** ticks missed "
        f"({lost / max(1, states):.2%}), {row['missed']} states lost in transfer. Late ticks (over "
        f"{_late_limit_ms(row):g} ms of work): **{late}** ({late / max(1, ticks):.2%}). Stalls of over "
        f"{1e3 * LAST_BIN_START:.0f} ms: **{n_stalls}**, the longest {1e3 * longest:.0f} ms. The simulation "
        f"fell behind the clock {row['slips']} times.",
        "",
    ]
    head = ("", "median", "99 %", "99.9 %", "longest")
    lines += markdown_table(head, ((name, *_format_ms(row[name])) for name in ("interval", "work", "latency")))
    lines += [
        "Interval: time between the arrivals of two joint states. Work: time from the arrival of a state to the end of "
        "its tick. Latency: time from the arrival of a state to the command for it. The next table divides the work "
        "into its parts; CPU: longest processor time of the control thread alone, without other threads and processes.",
        "",
    ]
    head = ("part of a tick", "content", "ticks with it", "mean", "median", "99 %", "99.9 %", "longest", "CPU")
    return lines + markdown_table(head, _part_rows(row["parts"], ticks)) + _background_lines(row)


def _late_limit_ms(row: Row) -> float:
    """A control of the loop is valid for some time in the control thread, and is late after it."""
    return 1e3 * (ControlThreadConfig().control_valid if row["control_thread"] else SIMULATED.max_tick_time)


def _part_rows(parts: dict[str, Any], n_ticks: int):
    for name, content in TICK_PARTS.items():
        part = parts[name]
        if part["ticks"] and name != "wait":
            times = (part["mean"], *part["quantiles"])
            cpu = f"{1e6 * part['cpu'][3]:.0f} µs" if "cpu" in part else "–"
            yield (name, content, f"{part['ticks'] / n_ticks:.1%}", *(f"{1e6 * value:.0f} µs" for value in times), cpu)


def _background_lines(row: Row) -> list[str]:
    decisions, recording = row["decisions"], row["recording"]
    n_messages, size = row["page"]
    plans = f"{len(decisions)} plans of `{row['planner']}`"
    plans += f" (median {median(decisions):.1f} s)" if decisions else ""
    contracts = ", ".join(f"{kind} {count}" for kind, count in sorted(row["contracts"].items()))
    outcomes = ", ".join(f"{kind} {count}" for kind, count in sorted(row["outcomes"].items()))
    completeness = "complete" if recording["complete"] else f"{recording['dropped']} messages dropped"
    return [
        f"Load: {plans}; contracts: {contracts}; outcomes: {outcomes}{_outcome_reasons(row)}; recording of "
        f"{recording['bytes'] / 1e6:.0f} MB, {completeness}; the page of the live view received {n_messages} messages, "
        f"{size / 1e6:.1f} MB. Violations: {describe_violations(row) or 'none'}.",
        "",
    ]


def _outcome_reasons(row: Row) -> str:
    """Return the most frequent reasons of the outcomes; empty for older rows, which do not store them."""
    reasons = "; ".join(f"{reason} ({count})" for reason, count in Counter(row.get("reasons", {})).most_common(3))
    return f" (most often: {reasons})" if reasons else ""


def _format_ms(values: list[float]) -> list[str]:
    return [f"{1e3 * value:.2f} ms" for value in values]
