"""Position servos behind the guard: actions and readings by the name of the servo, the newest safe values to write.

The servos follow the commanded position of the guard with a sag and a lag, which the tracking error of the robot model
bounds. Commands of servos without a joint, such as a gripper, pass unchanged.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from math import floor
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.result import FilterResult, FilterStatus
from dualbrain.safety.integration.policy_guard.guard import Deviation, GuardLimits, GuardReport, PolicyGuard
from dualbrain.safety.integration.policy_guard.joint_actions import JointPosition
from dualbrain.safety.integration.servo_bus.servo_map import ServoMap
from dualbrain.safety.integration.servo_bus.velocity_estimate import VelocityEstimate

Array = NDArray[np.float64]

INTERVENTION_DELTA = 1e-4
"""Change of the control above which the filter has intervened."""
ROUNDING = 1e-6
"""Share of a period of the filter that counts as rounding."""
JOINT_MOTION = "joint_motion"
"""Name of the limits of speed and acceleration among the barriers."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoState:
    """What the guard did since the last action began.

    `written`: the values last given out [deg, and as commanded]; empty before the first usable action. `intervened`:
    whether barriers or a problem changed the motion; clipping to the limits of speed and acceleration alone does not
    count. `intervening`: whether they did in the last period. `problem`: why the arm comes to rest, with a remedy; ""
    without one.
    """

    written: Mapping[str, float]
    intervened: bool
    intervening: bool
    problem: str


class GuardedServos:
    """One arm of position servos: `begin` an action, then `step` in every period of the filter.

    State: the guard with the commanded positions, the velocity estimate, and the values of the passed servos.
    """

    def __init__(
        self,
        safety: SafetyFilter,
        servos: ServoMap,
        *,
        action_period: float,
        deviation: Deviation = "nearest",
        limits: GuardLimits | None = None,
        predicts: bool = False,
    ) -> None:
        """Guard with `safety`, which must have no other caller.

        `action_period` [s] is the time between two actions; the motion of an action is spread over it, in whole periods
        of the filter: the nearest number, or with `predicts`, for one call per action, those that it has time for.
        """
        self.safety, self.servos = safety, servos
        self.period = safety.robot_model.period
        self._n_whole = max(1, floor(action_period / self.period + ROUNDING))
        steps = self._n_whole if predicts else max(1, round(action_period / self.period))
        self.action_period = steps * self.period
        self.guard = PolicyGuard(
            safety,
            JointPosition(layout=servos, stops=True),
            period=self.action_period,
            deviation=deviation,
            limits=limits or GuardLimits(),
        )
        self._velocity = VelocityEstimate()
        self.reset()

    def reset(self, commanded: Mapping[str, Any] | None = None) -> None:
        """Forget all actions and readings.

        `commanded` are the values [deg] that the servos hold now, if they are known; else the first reading counts, and
        the arm gives way by its sag when the first action begins.
        """
        start = None if commanded is None else self.servos.positions(commanded)
        self.guard.reset(start if start is not None and np.isfinite(start).all() else None)
        self._velocity.reset()
        self._passed: dict[str, float] = {}
        self._begun = self._intervened = self._intervening = False

    def check_range(self, reading: object) -> None:
        """Refuse a first `reading` (values [deg] by servo) that contradicts the robot model.

        Raises:
            ConfigurationError: a joint has no reading, or one outside of its range.
        """
        problem = self.servos.find_range_problem(self.servos.read_positions(reading))
        if problem:
            raise ConfigurationError.stating(
                f"{problem}.",
                fix="Calibrate the robot again, or state sign and offset: "
                "`calibration` = {elbow_flex: {sign: -1, offset: 3.0}}.",
            )

    @property
    def state(self) -> ServoState:
        """What happened since the last action began."""
        return ServoState(
            written=self._values() if self._begun else {},
            intervened=self._intervened,
            intervening=self._intervening,
            problem=self.guard.problem,
        )

    @property
    def report(self) -> GuardReport:
        """The report of the guard on the last action; raises `ConfigurationError` before the first step."""
        return self.guard.report

    def begin(self, action: Any, now: float) -> None:
        """Begin `action` (values [deg] by servo) at `now` [s]; an unusable one brings the arm to rest."""
        self._intervened = False
        self.guard.begin(action, now)
        if not self.servos.find_problem(action):
            self._accept(action)

    def rest(self, problem: str, now: float) -> None:
        """Begin no motion at `now` [s]: the arm comes to rest, and the state has the `problem`."""
        self._intervened = False
        self.guard.rest(problem, now)

    def step(self, reading: Any, now: float) -> dict[str, float] | None:
        """Filter one period at the `reading` (values [deg] by servo) and return the values to write.

        A reading that lacks a joint or is not finite brings the arm to rest. None before the first usable action: the
        servos hold what they hold.
        """
        q = self.servos.read_positions(reading)
        if not self._begun:
            self._velocity.update(now, q)
            return None
        result = self.guard.step(q, self._velocity.update(now, q), now)
        self._note(result)
        return self._values()

    def __call__(self, action: Any, reading: Any, now: float) -> dict[str, float]:
        """The safe values for one action in a loop without a bus: all periods at once, on the predicted motion.

        The joints then have to follow within the tracking error until the next call. The motion is at most that of the
        periods for which there is time until then, so that no speed exceeds its limit. Without a usable action and a
        usable reading so far, the mapping is empty: there is no safe value for the joints.
        """
        q = self.servos.read_positions(reading)
        v = self._velocity.update(now, q)
        self._intervened = False
        if self.servos.find_problem(action):
            self.guard.begin(action, now)
        else:
            self._accept(action)
        if not self._begun:
            return {}
        self.guard.begin(action, now)
        self._note(self.guard.step(q, v, now))
        for index in range(1, min(self.guard.steps_per_action, self._n_whole)):
            q, v = q + self.period * self.guard.control, self.guard.control
            self._note(self.guard.step(q, v, now + index * self.period))
        return self._values() if np.isfinite(self.guard.target).all() else {}

    def _accept(self, action: Mapping[str, Any]) -> None:
        self._begun = True
        self._passed |= {key: action[key] for key in self.servos.passed if key in action}

    def _note(self, result: FilterResult) -> None:
        """Keep whether barriers changed the control; limits of speed and acceleration of the joints do not count."""
        by_barriers = result.delta > INTERVENTION_DELTA and any(name != JOINT_MOTION for name in result.barriers)
        changed = by_barriers or result.status > FilterStatus.MODIFIED
        self._intervening = changed or bool(self.guard.problem)
        self._intervened = self._intervened or self._intervening

    def _values(self) -> dict[str, float]:
        target = self.guard.target
        known = self.servos.values(target) if np.isfinite(target).all() else {}
        return {**known, **self._passed}
