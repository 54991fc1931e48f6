"""The node without DDS: joint states and commands in, safe velocities and a diagnosis out.

The guard runs one step per period, for the joint state that is closest to its due time: single intervals follow the
jitter of the stamps, and the mean interval is the period. Every unusable input
brings the arm to rest for `recovery_time`, and cancels a trajectory. Without joint states the last control is braked
within the acceleration limits, one step per period.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import inf, isfinite, nan
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.drivers.ros2.command_sources import make_source
from dualbrain.drivers.ros2.joint_order import JointOrder, JointStates
from dualbrain.drivers.ros2.parameters import NodeParameters
from dualbrain.drivers.ros2.problems import Level, Problem, ProblemLog
from dualbrain.drivers.ros2.robot_description import DescriptionCheck
from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.result import FilterStatus
from dualbrain.safety.integration.policy_guard.guard import PolicyGuard

Array = NDArray[np.float64]

EARLY = 0.5
"""Share of the period by which a joint state may come before a step is due."""
LATE = 1.5
"""Periods between two steps beyond which a step counts as late: the control was held longer than the filter assumes."""

MAX_LATE_SHARE = 0.05
"""Share of late steps beyond which they are a warning: without a real-time kernel some come late."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Diagnosis:
    """The content of one diagnostic message: the worst level, its problem or the state, and named values."""

    level: Level
    message: str
    values: tuple[tuple[str, str], ...]


class CommandFilter:
    """Guards the commands of one controller; every method takes the time for timeouts and the time of ROS [s]."""

    def __init__(self, safety: SafetyFilter, parameters: NodeParameters, description: DescriptionCheck) -> None:
        """Guard with `safety`, whose robot model has the period of `parameters`.

        Raises:
            ConfigurationError: the robot has a mobile base, or names of joints or frames do not fit.
        """
        if safety.robot_model.is_mobile:
            raise ConfigurationError.stating(
                f"{safety.robot_model.name} has a mobile base; the node guards the velocities of an arm.",
                fix="Guard a mobile base in its own process with `SafetyFilter`.",
            )
        self.safety, self.parameters, self.description = safety, parameters, description
        self.order = JointOrder(safety.robot_model, parameters)
        self.problems = ProblemLog()
        self._source = make_source(parameters, self.order, safety)
        self._guard = PolicyGuard(safety, self._source.space, deviation=parameters.deviation)
        self._period = safety.robot_model.period
        self._steps = 0
        self._stamp, self._due = -inf, -inf
        self._state_time, self._step_time, self._command_time = -inf, -inf, -inf
        self._rest_until = -inf
        self._q: Array | None = None
        self._other_writers: tuple[str, ...] = ()
        self._sources: tuple[str, ...] = ()
        self._counts = dict.fromkeys(("steps", "late steps", "states refused", "commands", "commands refused"), 0)
        self._status, self._delta, self._h_min, self._explanation = FilterStatus.SAFE, 0.0, nan, ""

    @property
    def q(self) -> Array | None:
        """The last usable joint positions (n,) [rad] in the order of the robot model; None before the first."""
        return self._q

    # --- inputs -------------------------------------------------------------------------------------------------

    def receive_command(self, message: Any, now: float, ros_now: float) -> None:
        """Take a command, in the type of the source."""
        self._counts["commands"] += 1
        if self._q is None:
            text = (
                "A command came before the first joint state and is ignored. Remedy: start the robot before the policy"
            )
            self.problems.note(Level.WARN, "early", text)
            return
        problem = self._source.receive(message, self._q, ros_now)
        if problem:
            self._counts["commands refused"] += 1
            self.refuse("command", problem, now)
        elif self._source.may_be_silent and now < self._rest_until:
            self._drop_while_resting(self._q, ros_now)
        else:
            self._command_time = now

    def _drop_while_resting(self, q: Array, ros_now: float) -> None:
        """Forget a command that is not repeated, and report it: the arm rests, and the motion would be another one."""
        if self._source.action(q, ros_now) is None:  # it asks for no motion
            return
        self._source.cancel()
        self._counts["commands refused"] += 1
        text = (
            "A trajectory came while the arm rests after an unusable input, and is ignored. Remedy: send it again when "
            f"there has been no problem for {self.parameters.recovery_time:g} s (`recovery_time`)"
        )
        self.problems.note(Level.WARN, "resting", text)

    def receive_states(self, states: JointStates, now: float, ros_now: float) -> list[float] | None:
        """The safe velocities after a joint state, in the order of the controller; None if no step is due."""
        if not self.order.concerns(states.names):
            return None
        found = self._stamp_problem(states.stamp, ros_now) or self.order.read_states(states)
        if isinstance(found, str):
            self._counts["states refused"] += 1
            self.refuse("states", found, now)
            return None
        q, v = found
        first, self._q = self._q is None, q
        if first:
            self._guard.reset(q, v)
        self._stamp, self._state_time = states.stamp, now
        if states.stamp < self._due - EARLY * self._period:
            return None
        in_time = states.stamp < self._due + self._period
        self._due = (self._due if in_time else states.stamp) + self._period
        return self._step(q, v, now, ros_now)

    def idle(self, now: float) -> list[float] | None:
        """The next velocities while braking without joint states; None while they arrive, or before the first."""
        if self._q is None:
            self.problems.note(
                Level.STALE,
                "no states",
                f"No usable message on {self.parameters.joint_states_topic} yet. Remedy: start "
                "joint_state_broadcaster, and compare the names of the joints",
            )
            return None
        silent = now - self._state_time
        if silent <= self.parameters.state_silence or now - self._step_time < self._period:
            return None
        text = (
            f"No usable joint state for {silent:.2f} s; the arm comes to rest. Remedy: check joint_state_broadcaster "
            "and the network, or increase `state_timeout`"
        )
        return self.brake("silent states", text, now, Level.STALE)

    def brake(self, kind: str, text: str, now: float, level: Level = Level.ERROR) -> list[float] | None:
        """One step toward standstill without a joint state, because of the problem `text`."""
        self.refuse(kind, text, now, level)
        if self._q is None:
            return None
        unknown = np.full(len(self._q), nan)
        return self._send(unknown, unknown, np.zeros(self._source.size), now)

    def refuse(self, kind: str, text: str, now: float, level: Level = Level.ERROR) -> None:
        """Bring the arm to rest because of an input that is unusable; `text` states cause and remedy."""
        self.problems.note(level, kind, text)
        self._rest_until = now + self.parameters.recovery_time
        self._source.cancel()

    def restart_clock(self, text: str, now: float) -> None:
        """The clock of ROS jumped: the arm comes to rest, and the next joint state begins a new order of stamps."""
        self._stamp = self._due = -inf
        self._step_time = min(self._step_time, now)
        self._state_time = min(self._state_time, now)
        self._command_time = -inf
        self._rest_until = -inf  # on the clock before the jump
        self.refuse("clock", text, now)

    def report_writers(self, others: tuple[str, ...], sources: tuple[str, ...] = ()) -> None:
        """Set the `others` that publish the safe command and all `sources` of commands: beside others the arm rests."""
        self._other_writers, self._sources = others, sources

    # --- one step -----------------------------------------------------------------------------------------------

    def _stamp_problem(self, stamp: float, ros_now: float) -> str:
        """Why a joint state with this stamp is unusable, or ""."""
        if not (isfinite(stamp) and stamp > 0.0):
            return "joint_states has no time stamp. Remedy: publish it with joint_state_broadcaster"
        if stamp <= self._stamp:
            return (
                f"A joint state is {self._stamp - stamp:.3f} s older than the one before it. Remedy: let one node only "
                "publish joint_states"
            )
        age = ros_now - stamp
        if abs(age) > self.parameters.max_state_age:
            where = f"{age:.2f} s old" if age > 0.0 else f"{-age:.2f} s in the future"
            return (
                f"A joint state is {where}, allowed are {self.parameters.max_state_age:g} s. Remedy: synchronise the "
                "clocks of the machines, or set `use_sim_time` as the robot does"
            )
        return ""

    def _step(self, q: Array, v: Array, now: float, ros_now: float) -> list[float]:
        """One step of the guard at a usable joint state."""
        if isfinite(self._step_time) and now - self._step_time > LATE * self._period:
            self._counts["late steps"] += 1
        return self._send(q, v, self._action(q, now, ros_now), now)

    def _action(self, q: Array, now: float, ros_now: float) -> Array:
        """The action for this step: that of the last command, or rest."""
        rest = np.zeros(self._source.size)
        if problem := self._standing_problem():
            self.refuse("standing", problem, now)
            return rest
        silent = now - self._command_time
        if self.parameters.command_timeout < silent < inf and not self._source.may_be_silent:
            self.problems.note(
                Level.STALE,
                "silent command",
                f"No command on {self.parameters.command_topic} for {silent:.2f} s; the arm comes to rest. Remedy: "
                "check the policy or controller, or increase `command_timeout`",
            )
            return rest
        if now < self._rest_until:
            self._source.cancel()
            return rest
        action = self._source.action(q, ros_now)
        if isinstance(action, str):
            self.refuse("command", action, now)
        return rest if action is None or isinstance(action, str) else action

    def _standing_problem(self) -> str:
        """The problem that lasts until its cause is removed, or ""."""
        if self._other_writers:
            return (
                f"{', '.join(self._other_writers)} also publishes on {self.parameters.safe_command_topic}, past the "
                f"filter. Remedy: remap its output to {self.parameters.command_topic}"
            )
        if len(self._sources) > 1 and self.parameters.one_source:
            return (
                f"{' and '.join(self._sources)} publish on {self.parameters.command_topic}. Remedy: start one of them "
                "only, let a multiplexer choose, or set `one_source` to false"
            )
        return self.description.problem

    def _send(self, q: Array, v: Array, action: Array, now: float) -> list[float]:
        """Filter `action`, and note the result."""
        time = self._steps * self._period  # the guard counts its periods
        self._steps += 1
        self._guard.begin(action, time)
        result = self._guard.step(q, v, time)
        self._step_time = now
        self._counts["steps"] += 1
        usable = bool(np.isfinite(q).all())
        if usable and result.status >= FilterStatus.STOPPED:
            text = f"{result.explain()} Remedy: move the arm or the obstacle by hand, and compare the scene"
            self.problems.note(Level.ERROR, "filter", text)
        self._status = max(self._status, result.status)
        self._delta = max(self._delta, result.delta)
        self._h_min = float(np.fmin(self._h_min, result.h_min))
        if usable and result.delta >= self._delta:
            self._explanation = result.explain()
        return self.order.to_controller(result.u)

    # --- diagnosis ----------------------------------------------------------------------------------------------

    def diagnose(self, now: float) -> Diagnosis:
        """The diagnosis since the last call."""
        if problem := self._standing_problem():
            self.problems.note(Level.ERROR, "standing", problem)
        if self.description.warning:
            self.problems.note(Level.WARN, "description", self.description.warning)
        late, steps = self._counts["late steps"], self._counts["steps"]
        if late > MAX_LATE_SHARE * steps:
            text = (
                f"{late} of {steps} steps came more than {LATE:g} periods after the one before. Remedy: publish "
                f"joint_states at {1.0 / self._period:g} Hz or more, or set `period` to their interval"
            )
            self.problems.note(Level.WARN, "late", text)
        problems = self.problems.take()
        worst = problems[0][0] if problems else Problem(Level.OK, self._state(now))
        values = [
            ("filter", self._status.name),
            ("delta_max", f"{self._delta:.6f}"),
            ("h_min", f"{self._h_min:.4f}"),
            ("explanation", self._explanation),
            *((name, str(count)) for name, count in self._counts.items()),
            ("robot_description", self.description.summary),
            ("order of the joints", ", ".join(self.order.names)),
            *(("problem", f"{problem.text} ({count} times)") for problem, count in problems),
        ]
        self._counts = dict.fromkeys(self._counts, 0)
        self._status, self._delta, self._h_min, self._explanation = FilterStatus.SAFE, 0.0, nan, ""
        return Diagnosis(level=worst.level, message=worst.text, values=tuple(values))

    def _state(self, now: float) -> str:
        """The state without a problem."""
        if now < self._rest_until:
            return "The arm rests after an unusable input."
        if not isfinite(self._command_time):
            return "Ready; no command yet."
        return "Commands pass unchanged." if self._delta == 0.0 else "Commands are made safe."
