"""The Franka driver and the filter against an independent simulator that enforces the limits of the FR3."""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.control.gatekeeper.robot_link.driver_process import REPLY_FRACTION
from dualbrain.core.geometry.shapes import HalfSpace
from dualbrain.drivers.franka import FrankaDriver, import_franka_sdk
from dualbrain.records import Pose
from dualbrain.robots.interface import Command
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import Bound, RobotModel
from dualbrain.safety.cbf.config import FilterConfig
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.cbf.result import FilterStatus
from dualbrain.safety.stop_cause import Reason
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table
from experiments.robots.franka_sim.server import running_server

Array = NDArray[np.float64]
VELOCITY_SHARE, ACCELERATION_SHARE, JERK_SHARE = 0.9, 0.97, 0.97
"""Shares of the manufacturer's limits; commissioning requires at most 98 %, because the arm's limits are exact."""
RANDOM_UNITS, RANDOM_SECONDS = 14, 10.0
APPROACH_UNITS, SWEEPS, SWEEP_SECONDS = 17, 6, 3.8
JOINT_SETS = ((0, 2, 4, 6), (1,), (0, 2, 4, 6), (3,), (0, 2, 4, 6), (5,))
"""Joints of the sweeps of a session: joints that turn about the links move together, the others alone from home."""
HOME_GAIN, HOME_SECONDS = 3.0, 2.0
"""Return to the home posture before a sweep: gain [1/s] and duration [s]."""
CONTROL_UNITS, CONTROL_SECONDS = 3, 2.0
HOLD_TICKS = 400
"""Ticks for which a random wish is held."""
REPLY_TIME = REPLY_FRACTION * FrankaDriver.timing.period
"""Time [s] after a state beyond which no command is sent for it, as in the driver process; the arm continues alone."""
REACHED, FULL_SPEED = 0.05, 0.8
"""An approach ends this close to the end of a joint [rad], after at least this share of its velocity limit."""
EXPECTED_ERROR = "joint_motion_generator_acceleration_discontinuity"
"""The error of the arm for an excessive jerk."""


def narrowed_fr3() -> RobotModel:
    """The FR3 with the shares of its limits that the filter uses."""
    robot_model = load_robot("fr3")

    def share(bound: Bound, factor: float) -> Bound:
        return msgspec.structs.replace(bound, value=factor * bound.value)

    joints = tuple(
        msgspec.structs.replace(
            joint,
            velocity=share(joint.velocity, VELOCITY_SHARE),
            acceleration=share(joint.acceleration, ACCELERATION_SHARE),
            jerk=share(joint.jerk, JERK_SHARE) if joint.jerk else None,
        )
        for joint in robot_model.joints
    )
    return msgspec.structs.replace(robot_model, joints=joints)


class Session:
    """One motion of the simulated arm: every tick reads a state, filters a wish and writes the result."""

    def __init__(self, address: str, *, jerk_limits: bool) -> None:
        """Connect and enable; the first wish may follow at once."""
        self.robot_model = narrowed_fr3()
        self.v_max = np.array([joint.velocity.value for joint in self.robot_model.joints])
        self.j_max = np.array([joint.jerk.value for joint in self.robot_model.joints if joint.jerk])
        self.lower = np.array([joint.lower.value for joint in self.robot_model.joints])
        self.upper = np.array([joint.upper.value for joint in self.robot_model.joints])
        self.driver = FrankaDriver(import_franka_sdk(), address, self.robot_model, hand=False, realtime="ignore")
        self._filter = SafetyFilter(self.robot_model, FilterConfig(jerk_limits=jerk_limits))
        self._filter.observe([Obstacle("floor", HalfSpace(), Pose((0.0, 0.0, 0.0)))])
        self._filter(self.driver.read().q, np.zeros(7), np.zeros(7))  # the first step is slower than a period
        self._filter.reset()
        self.driver.enable()
        self.status: Counter[str] = Counter()
        self.causes: Counter[str] = Counter()
        self.q = self.driver.read().q
        self.ticks, self.jerk_dropped, self.largest_jerk, self.states_missed = 0, 0, 0.0, 0
        self.commands_lost = self.commands_late = 0
        self._u = self._u_before = np.zeros(7)
        self.first_stop, self.success_rate = "", 1.0
        self._sequence = self.driver.read().sequence

    def tick(self, wish: Array) -> bool:
        """One period with the nominal control `wish` (7,) [rad/s]; False if the arm has aborted the motion."""
        self.driver.wait()
        received, state = time.monotonic(), self.driver.read()
        if self.driver.faults():
            return False
        if not state.executes(self._u) and state.desired_v is not None and state.desired_a is not None:
            self._continue(state.desired_v, state.desired_a)
        result = self._filter(state.q, state.v, wish)
        if time.monotonic() - received < REPLY_TIME:
            self.driver.write(Command(result.u, 0.0, 0.0))
        else:
            self.commands_late += 1
        jerk = np.abs(result.u - 2.0 * self._u + self._u_before) / self.j_max / self.robot_model.period**2
        self._u_before, self._u = self._u, result.u
        self.largest_jerk = max(self.largest_jerk, float(jerk.max()))
        self.jerk_dropped += Reason.JERK in result.reason
        self.states_missed += max(0, state.sequence - self._sequence - 1)
        self._sequence = state.sequence
        self.status[result.status.name] += 1
        if result.status >= FilterStatus.STOPPED:
            self.causes[str(result.cause)] += 1
            if not self.first_stop:
                self.first_stop = result.explain()
        self.success_rate = self.driver.success_rate
        self.ticks += 1
        self.q = state.q
        return not self.driver.faults()

    def _continue(self, v: Array, a: Array) -> None:
        """Continue the motion of the arm after a lost command, as `SafetyController.continue_desired_motion` does."""
        change = a * self.robot_model.period
        self._filter.reset(v, change)
        self._u, self._u_before = v, v - change
        self.commands_lost += 1

    def row(self) -> Row:
        """What happened, as a row of the log."""
        return {
            "ticks": self.ticks,
            "faults": list(self.driver.faults()),
            "status": dict(self.status),
            "jerk_dropped": self.jerk_dropped,
            "largest_jerk": self.largest_jerk,
            "states_missed": self.states_missed,
            "commands_lost": self.commands_lost,
            "commands_late": self.commands_late,
            "causes": dict(self.causes),
            "first_stop": self.first_stop,
            "success_rate": self.success_rate,
        }


def run_random(session: Session, rng: np.random.Generator, seconds: float) -> Row:
    """Random wishes at up to full speed, from the first tick after `enable`."""
    for tick in range(int(seconds * 1000)):
        if tick % HOLD_TICKS == 0:
            wish = rng.uniform(-1.0, 1.0, 7) * session.v_max
        if not session.tick(wish):
            break
    return session.row()


def run_approaches(session: Session, rng: np.random.Generator, seconds: float) -> Row:
    """Joints of one set toward an end of their range at full speed for `seconds`, `SWEEPS` times from home."""
    approaches, home = 0, np.array(session.robot_model.home)
    for sweep in range(SWEEPS):
        for _ in range(int(HOME_SECONDS * 1000)):
            back = np.clip(HOME_GAIN * (home - session.q), -session.v_max, session.v_max)
            if not session.tick(back):
                return {**session.row(), "approaches": approaches}
        side = np.zeros(7)
        chosen = list(JOINT_SETS[sweep % len(JOINT_SETS)])
        side[chosen] = rng.choice([-1.0, 1.0], len(chosen))
        fastest = np.zeros(7)
        for _ in range(int(seconds * 1000)):
            if not session.tick(side * session.v_max):
                return {**session.row(), "approaches": approaches}
            fastest = np.maximum(fastest, side * session._u)
        left = np.where(side > 0.0, session.upper - session.q, session.q - session.lower)
        approaches += int(np.sum((side != 0.0) & (left < REACHED) & (fastest > FULL_SPEED * session.v_max)))
    return {**session.row(), "approaches": approaches}


RUNNERS: dict[str, Callable[[Session, np.random.Generator, float], Row]] = {
    "random": run_random,
    "approach": run_approaches,
    "control": run_random,
}


class FrankaLimits:
    """The arm's own limits are kept, also at the ends of the joints and right after the start of a motion."""

    name = "franka_limits"
    claim = (
        "Against franka-sim 1.1.7, which enforces the limits of the FR3 independently of dualbrain, the driver and the "
        "filter with jerk limits cause no reflex while all commands arrive, in at least 60 s of random wishes and 200 "
        "approaches to joint limits at full speed; without jerk limits the arm aborts with "
        "joint_motion_generator_acceleration_discontinuity."
    )
    intervals = "none: counts"

    def units(self, options: Options) -> list[WorkUnit]:
        """Random wishes, approaches, and the negative control without jerk limits."""
        del options
        plan = (
            ("control", CONTROL_UNITS, CONTROL_SECONDS),
            ("random", RANDOM_UNITS, RANDOM_SECONDS),
            ("approach", APPROACH_UNITS, SWEEP_SECONDS),
        )
        return [
            WorkUnit(f"{kind}:{seed}", {"kind": kind, "seed": seed, "seconds": seconds})
            for kind, count, seconds in plan
            for seed in range(count)
        ]

    def run(self, parameters: dict[str, Any]) -> Row:
        """One session with a simulator of its own."""
        kind = parameters["kind"]
        rng = np.random.default_rng([parameters["seed"], sorted(RUNNERS).index(kind)])
        with running_server() as address:
            session = Session(address, jerk_limits=kind != "control")
            try:
                row = RUNNERS[kind](session, rng, parameters["seconds"])
            finally:
                session.driver.close()
        return {"kind": kind, **row}

    def summarize_row(self, row: Row) -> str:
        """Ticks, approaches and the error of the arm."""
        approaches = f", {row['approaches']} approaches" if "approaches" in row else ""
        return f"{row['ticks']} ticks{approaches}; {'; '.join(row['faults']) or 'no reflex'}"

    def report(self, rows: list[Row]) -> list[str]:
        """One line per kind of session, and every reflex."""
        cells = [
            _line(kind, [row for row in rows if row["kind"] == kind]) for kind in ("random", "approach", "control")
        ]
        head = (
            "sessions",
            "simulated time",
            "approaches",
            "reflexes (after lost packets)",
            "largest jerk, share of the filter's limit",
            "jerk limit dropped",
            "status " + " / ".join(status.name for status in FilterStatus),
            "states missed",
            "commands lost",
            "not sent, because late",
        )
        reflexes = [
            (row["key"], "; ".join(row["faults"]), row["ticks"], f"{row['success_rate']:.0%}")
            for row in rows
            if row["faults"]
        ]
        named = sum(any(EXPECTED_ERROR in fault for fault in row["faults"]) for row in rows if row["kind"] == "control")
        lines = [*markdown_table(head, [cell for cell in cells if cell]), ""]
        lines += [f"Sessions without jerk limits that ended with `{EXPECTED_ERROR}`: {named}.", ""]
        return lines + (
            markdown_table(("session", "reflex", "tick", "commands received, of the last 100"), reflexes)
            if reflexes
            else ["No reflex."]
        )


def _lost_packets(row: Row) -> bool:
    """Whether the arm had missed commands in the 100 ms before a reflex; it then extrapolates them."""
    return bool(row["faults"]) and row["success_rate"] < 1.0


def _line(kind: str, rows: list[Row]) -> tuple[object, ...]:
    """The totals of one kind of session; empty without rows."""
    if not rows:
        return ()
    titles = {
        "random": "random wishes",
        "approach": "approaches to joint limits",
        "control": "random wishes, no jerk limits",
    }
    status: Counter[str] = sum((Counter(row["status"]) for row in rows), Counter())
    return (
        f"{titles[kind]} ({len(rows)})",
        f"{sum(row['ticks'] for row in rows) / 1000:.1f} s",
        sum(row.get("approaches", 0) for row in rows) or "",
        f"{sum(bool(row['faults']) for row in rows)} ({sum(_lost_packets(row) for row in rows)})",
        f"{max(row['largest_jerk'] for row in rows):.4f}",
        sum(row["jerk_dropped"] for row in rows),
        " / ".join(str(status[one.name]) for one in FilterStatus),
        sum(row["states_missed"] for row in rows),
        sum(row.get("commands_lost", 0) for row in rows),
        sum(row.get("commands_late", 0) for row in rows),
    )
