"""The guard: a policy's action in, the closest safe action out, in any action space and for any robot model.

Within one action the nominal control of its action space is filtered once per period of the robot model:

    u = argmin ‖u − u_nom‖² over the safe controls,      q_c ← q_c + u dt

q_c is the commanded configuration, from which the safe action is made. A policy whose period is longer than that of
the filter is filtered several times per action: in a loop that measures in between (`begin`, `step`), or within one
call, on the predicted motion. Unusable actions and states bring the arm to rest; `GuardReport.problem` states cause and
remedy.
"""

from __future__ import annotations

from collections.abc import Sized
from copy import copy
from dataclasses import dataclass
from math import inf, isfinite, nan
from typing import Any, Literal

import numpy as np
from numpy.typing import ArrayLike, NDArray

from dualbrain.core.geometry.validation import as_real_array, check_positive
from dualbrain.errors import ConfigurationError
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.result import FilterResult, FilterStatus, LimitKind
from dualbrain.safety.integration.policy_guard.action_space import ActionGoal, ActionSpace, GuardedArm
from dualbrain.safety.integration.policy_guard.joint_actions import JointVelocity
from dualbrain.safety.integration.policy_guard.path_braking import brake_along_path, braking_step
from dualbrain.safety.integration.policy_guard.tracking_margin import check_tracking_margin
from dualbrain.safety.integration.shadow_mode import ShadowFilter

Array = NDArray[np.float64]
HOLD_TIME = 0.1
"""Time [s] without a step after which a robot that follows positions rests at the commanded one."""
Deviation = Literal["nearest", "along_path"]
DEVIATIONS: tuple[Deviation, ...] = ("nearest", "along_path")
"""How the guard deviates from a nominal control: to the nearest safe control, or by braking along its direction."""


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardLimits:
    """Limits beyond which the guard brings the arm to rest.

    `following_error` [rad]: largest distance between the commanded and the measured position of a joint.
    `action_timeout` [s]: time after the end of an action for which a loop that calls `step` may be without a new one.
    """

    following_error: float = 0.35
    action_timeout: float = 0.2

    def __post_init__(self) -> None:
        """Check the limits; raises `ConfigurationError`."""
        check_positive("GuardLimits.following_error [rad]", self.following_error)
        check_positive("GuardLimits.action_timeout [s]", self.action_timeout)


@dataclass(frozen=True, slots=True, kw_only=True)
class GuardReport:
    """What the guard did with one action.

    `changed`: whether the action differs from that of the policy. `status`: the highest status of the filter. `delta`:
    mean change of the control by the filter; `delta_rows` is the part that is not due to jumps beyond joint limits.
    `speed_share`: the smallest share of the commanded speed while braking along the path, 1 without braking.
    `h_min` [m]: the smallest h before a step. `explanation`: the largest change as a sentence. `limit`: the kind of
    limit that caused it; NONE for braking along the path. `problem`: why the arm comes to rest, with a remedy; ""
    without one.
    """

    changed: bool
    status: FilterStatus
    delta: float
    delta_rows: float
    speed_share: float
    h_min: float
    explanation: str
    limit: LimitKind
    problem: str


@dataclass(frozen=True, slots=True, kw_only=True)
class StepResults:
    """The results of the filter since an action began: the last, that with the largest change, and sums.

    `count` steps; `delta` and `delta_rows` are sums; `h_min` [m] is NaN if no step computed it.
    """

    last: FilterResult
    largest: FilterResult
    count: int
    status: FilterStatus
    delta: float
    delta_rows: float
    h_min: float

    @classmethod
    def after(cls, before: StepResults | None, result: FilterResult) -> StepResults:
        """The results with one more."""
        if before is None:
            return cls(
                last=result,
                largest=result,
                count=1,
                status=result.status,
                delta=result.delta,
                delta_rows=result.delta_rows,
                h_min=result.h_min,
            )
        return cls(
            last=result,
            largest=result if result.delta > before.largest.delta else before.largest,
            count=before.count + 1,
            status=max(before.status, result.status),
            delta=before.delta + result.delta,
            delta_rows=before.delta_rows + result.delta_rows,
            h_min=float(np.fmin(before.h_min, result.h_min)),
        )


class PolicyGuard:
    """Replaces the actions of one policy by safe ones.

    Two lines put it in front of a robot or an environment, also one whose loop is slower than the filter:

        guard = PolicyGuard(SafetyFilter(robot_model, obstacles=obstacles), JointPosition(), period=0.02)
        action = guard(action, q, v)

    State: the commanded configuration `target` (n,), the action in progress, and the `report` on the last one.
    """

    def __init__(
        self,
        safety: SafetyFilter | ShadowFilter,
        space: ActionSpace,
        *,
        period: float | None = None,
        action_size: int | None = None,
        deviation: Deviation = "nearest",
        limits: GuardLimits = GuardLimits(),
    ) -> None:
        """Guard with `safety`, which must have no other caller; a `ShadowFilter` reports and changes nothing.

        `period` [s] is the time between two actions, by default the period of the robot model; it must be a multiple of
        that (`derate`). `action_size` is the number of entries of an action, by default that of the first usable one.
        `deviation`: the control becomes the nearest safe one, or "along_path" brakes along the commanded direction as
        long as that is safe (`path_braking.py`).

        Raises:
            ConfigurationError: the period or the layout does not fit; the tracking error of the robot model is not
                identified, and the configuration of the filter states none; a robot with a mobile base gets other
                actions than velocities, one per period; or "along_path" with a mobile base, Python barriers or
                `ShadowFilter`.
        """
        self.shadow = safety if isinstance(safety, ShadowFilter) else None
        self.safety = safety.safety if isinstance(safety, ShadowFilter) else safety
        self.space, self.limits, self._brakes_along_path = space, limits, deviation == "along_path"
        if deviation not in DEVIATIONS:
            raise ConfigurationError("deviation of the guard", got=deviation, allowed=" or ".join(DEVIATIONS))
        if self._brakes_along_path and self.shadow:
            raise ConfigurationError.stating(
                'deviation="along_path" changes the control, and a ShadowFilter changes nothing.',
                fix='Observe with deviation="nearest".',
            )
        if self._brakes_along_path and not self.safety.has_batch:
            raise ConfigurationError.stating(
                'deviation="along_path" compares controls at once: it needs a fixed base and no Python barriers.',
                fix='Guard this filter with deviation="nearest".',
            )
        self._model = self.safety.robot_model
        check_tracking_margin(self._model, self.safety.config)
        self._dt = self._model.period
        self.steps_per_action = self._count_steps(period)
        self._count = space.count(self._model.n)
        space.layout.check(self._count)
        self._size: int | None = action_size
        self._template: Any = None
        self._original: Any = None
        self._velocity_limits = np.array([joint.velocity.value for joint in self._model.joints])
        self._braking_step = braking_step(self._model)
        self._lower = np.array([joint.lower.value for joint in self._model.joints])
        self._upper = np.array([joint.upper.value for joint in self._model.joints])
        self.reset()

    def _count_steps(self, period: float | None) -> int:
        length = self._dt if period is None else period
        steps = round(length / self._dt) if isfinite(length) else 0
        if self._model.is_mobile and (steps != 1 or not isinstance(self.space, JointVelocity)):
            raise ConfigurationError.stating(
                f"{self._model.name} has a mobile base, whose pose does not follow from its controls alone.",
                fix="Guard it with velocity actions (`JointVelocity`), one per period of the robot model.",
            )
        if steps < 1 or abs(steps * self._dt - length) > 1e-6 * length:
            allowed = f"a multiple of the period of the robot model, {self._dt:g}"
            fix = (
                "Build the filter for `derate(robot_model, period=...)`: the period of the policy divided by 1, 2, 3 …"
            )
            raise ConfigurationError("period of the policy [s]", got=length, allowed=allowed, fix=fix)
        if steps > 1 and not self.space.commands_velocity:
            fix = "Send a torque in every period of the filter, or `derate(robot_model, period=...)`."
            raise ConfigurationError("period of torque actions [s]", got=length, allowed=f"{self._dt:g}", fix=fix)
        return steps

    def reset(self, q: ArrayLike | None = None, v: ArrayLike = 0.0) -> None:
        """Begin at `q` (n,) [rad] with the joint velocity `v`; without a finite `q` at that of the first step.

        A joint without a finite velocity begins at rest.
        """
        start = None if q is None else as_real_array("q", q, (self._model.nq,)).copy()
        self._target = start if start is not None and np.isfinite(start).all() else None
        self.safety.reset(v)
        if self.shadow:
            self.shadow.reset()
        self._goal: ActionGoal | None = None
        self._values: Array | None = None
        self._arm: GuardedArm | None = None
        self._now, self._until, self._problem = -inf, 0.0, ""
        self._results: StepResults | None = None
        self._has_begun = False
        self._speed_share, self._u_prev = 1.0, self._start_velocity(v)
        self._last_command: Array | None = None
        self._changed = False

    def retarget(self, q: ArrayLike) -> None:
        """Take `q` (n,) [rad] as the commanded configuration, where another controller than the guard changes it.

        Raises:
            ConfigurationError: `q` does not have n finite entries.
        """
        target = as_real_array("q", q, (self._model.n,)).copy()
        if not np.isfinite(target).all():
            raise ConfigurationError("q", got=target.tolist(), allowed=f"{self._model.n} finite numbers")
        self._target = target

    def _start_velocity(self, v: ArrayLike) -> Array:
        """The joint velocity `v` at the beginning, one number or (n,), as an array."""
        start = np.broadcast_to(np.asarray(v, float), (self._model.n,))
        return np.where(np.isfinite(start), start, 0.0)

    @property
    def target(self) -> Array:
        """The commanded configuration (n,) [rad], for a robot that takes joint positions; NaN before the first step."""
        return np.full(self._model.n, nan) if self._target is None else self._target.copy()

    @property
    def control(self) -> Array:
        """The last safe control (n,) [rad/s], for a robot that takes joint velocities; NaN before the first step."""
        return self._results.last.u if self._results else np.full(self._model.n, nan)

    @property
    def problem(self) -> str:
        """Why the arm comes to rest, with a remedy; "" without a problem since the last action began."""
        return self._problem

    @property
    def report(self) -> GuardReport:
        """What the guard did since the last action began; raises `ConfigurationError` before the first step."""
        results = self._results
        if results is None:
            raise ConfigurationError.stating("The guard has filtered no action yet.", fix="Call the guard first.")
        return GuardReport(
            changed=self._changed,
            status=results.status,
            delta=results.delta / results.count,
            delta_rows=results.delta_rows / results.count,
            speed_share=self._speed_share,
            h_min=results.h_min,
            explanation=self._describe_change() if self._is_unfiltered_change else results.largest.explain(),
            limit=self._limit_kind(results.largest),
            problem=self._problem,
        )

    @property
    def _is_unfiltered_change(self) -> bool:
        """Whether the filter changed nothing, but the motion of the action is another one."""
        results = self._results
        is_unfiltered = results is not None and results.status is FilterStatus.SAFE and results.delta == 0.0
        return self._changed and not self._problem and is_unfiltered and self._speed_share == 1.0

    @property
    def _takes_longer(self) -> bool:
        """Whether the filter changed nothing, but the motion of the action needs more time than one action has."""
        is_curved = self.space.curves and self._arm is not None and not self._arm.shortened
        return self._is_unfiltered_change and not is_curved

    def _describe_change(self) -> str:
        """Why an action that the filter did not change is replaced."""
        assert self._arm is not None
        if not self._takes_longer:
            return "the tool moves on a curve within this action: the action states the motion that the filter checked"
        shares = np.abs(self._arm.velocity) / self._velocity_limits
        fastest = int(np.argmax(shares))
        share, joint = 100.0 * shares[fastest], self._model.joints[fastest]
        return (
            f"the motion takes longer than one action: {joint.name} moves at {share:.0f} % of its velocity limit, "
            f"{joint.velocity.value:.3g} {joint.velocity.unit}"
        )

    def _limit_kind(self, largest: FilterResult) -> LimitKind:
        if self._problem:
            return LimitKind.INPUT
        return LimitKind.SPEED if self._takes_longer else largest.limit_kind

    # --- one call per action ------------------------------------------------------------------------------------

    def __call__(
        self, action: Any, q: ArrayLike, v: ArrayLike, now: float | None = None, opening: float | None = None
    ) -> Any:
        """The safe action for `action` at the joint state `q`, `v` (n,) [rad, rad/s].

        `now` [s] is on the clock of the scene; by default the guard counts its periods. `opening` [m] of each finger is
        unknown by default, so the fingers cover every opening. An action that the filter does not change is returned as
        it is. If the policy is slower than the filter, the joint state between its periods is predicted: the joints
        then have to follow within the tracking error of the robot model.

        Raises:
            ConfigurationError: the first action or joint state of all is not usable, or a joint state while torques are
                commanded, so that no action can stop the arm.
        """
        start, late = self._next_start(now), self._late_problem(now) if self._has_begun else ""
        self.begin(action, start)
        self._refuse(late)
        self._run_periods(q, v, start, opening)
        return self.command()

    def stop(
        self, problem: str, q: ArrayLike, v: ArrayLike, now: float | None = None, opening: float | None = None
    ) -> Any:
        """The action that brings the arm to rest because of `problem`, instead of the action of the policy.

        The parameters and errors are those of a call; an unknown joint state is NaN.
        """
        start = self._next_start(now)
        self.rest(problem, start)
        self._run_periods(q, v, start, opening)
        return self.command()

    def _next_start(self, now: float | None) -> float:
        return now if now is not None else self._now + self._dt if isfinite(self._now) else 0.0

    def _run_periods(self, q: ArrayLike, v: ArrayLike, start: float, opening: float | None) -> None:
        """Filter all periods of one action; the joint state is measured in the first one, and predicted afterwards."""
        q, v = self._measured(q, v)
        self.step(q, v, start, opening)
        for index in range(1, self.steps_per_action):
            predicted = q if self._arm is None else q + self._arm.target - self._arm.start
            self.step(predicted, self.control, start + index * self._dt, opening)

    # --- a loop that measures in every period of the filter -----------------------------------------------------

    def begin(self, action: Any, now: float) -> None:
        """Begin `action` at `now` [s]; `step` moves the arm."""
        self.rest("", now)
        values = self.space.layout.read(action, self._count, self._size)
        self._original = action
        if isinstance(values, str):
            self._refuse(f"{values}; the arm comes to rest. Remedy: check the output of the policy")
        else:
            self._values, self._template = values, copy(action)
            self._size = len(action) if isinstance(action, Sized) else None

    def rest(self, problem: str, now: float) -> None:
        """Begin no motion at `now` [s]: the arm comes to rest, and the report states the `problem`."""
        self._problem, self._results, self._goal, self._arm = problem, None, None, None
        self._speed_share, self._original, self._values = 1.0, None, None
        self._until, self._has_begun = now + self.steps_per_action * self._dt, True

    def step(self, q: ArrayLike, v: ArrayLike, now: float, opening: float | None = None) -> FilterResult:
        """Filter one period at the measured joint state; `target` and the `u` of the result command the robot."""
        q, v = self._measured(q, v)
        usable = bool(np.isfinite(q).all() and np.isfinite(v).all())
        if not usable:
            self._refuse(
                "The joint state is not finite; the arm comes to rest. Remedy: check the sensors of the joints"
            )
        self._check_clock(now)
        self._end_hold(now)
        arm = self._current_arm(q, v)
        self._check_following(q, arm)
        nominal = self._nominal(arm, now)
        result = self._filter(q, v, nominal, now, opening)
        self._now = now if isfinite(now) else self._now
        self._move_target(arm, nominal if self.shadow else result.u)
        self._results = StepResults.after(self._results, result)
        return result

    def command(self) -> Any:
        """The safe action for the motion since `begin`, in the layout of the policy."""
        arm, goal = self._arm, self._goal
        if arm is None or goal is None or self._results is None:
            raise ConfigurationError.stating("No action has begun.", fix="Call `begin` and `step` first.")
        safe = self._results.status is FilterStatus.SAFE
        self._changed = self.shadow is None and not (safe and not self._problem and goal.is_reached(arm))
        if not self._changed:
            self._last_command = goal.command(arm)
            return self._original
        values = goal.command(arm)
        if not np.isfinite(values).all():
            values = self.space.standstill(self._last_command, self._model.n)
        if values is None or self._template is None:
            raise ConfigurationError.stating(f"No action can stop the arm: {self._problem}", fix="Stop its drives.")
        self._last_command = values
        return self.space.layout.write(values, self._template)

    # --- parts of a step ----------------------------------------------------------------------------------------

    def _measured(self, q: ArrayLike, v: ArrayLike) -> tuple[Array, Array]:
        """The joint state as arrays; values that are not finite are NaN, which the filter answers with a stop."""
        arrays: list[Array] = []
        for name, values, size in (("q", q, self._model.nq), ("v", v, self._model.n)):
            try:
                array = as_real_array(name, values, (size,))
                arrays.append(np.where(np.isfinite(array), array, nan))
            except ConfigurationError as error:
                self._refuse(f"{error} The arm comes to rest")
                arrays.append(np.full(size, nan))
        return arrays[0], arrays[1]

    def _check_clock(self, now: float) -> None:
        if not (isfinite(now) and now > self._now):
            text = f"The time {now:g} s is not after that of the last step, {self._now:g} s; the arm comes to rest"
            self._refuse(
                f"{text}. Remedy: use one monotonic clock for states and actions, and send no action before the period "
                "of the last one is over"
            )
        self._refuse(self._late_problem(now))

    def _late_problem(self, now: float | None) -> str:
        """Why there was no action for too long before `now` [s], or ""."""
        if now is None or not isfinite(now) or now <= self._until + self.limits.action_timeout:
            return ""
        return f"The last action ended {now - self._until:.2f} s ago; the arm comes to rest. Remedy: check the policy"

    def _end_hold(self, now: float) -> None:
        """After a time without steps, a robot that follows positions has come to rest: the last control was zero."""
        if self.space.follows_position and now - self._now > HOLD_TIME and isfinite(self._now):
            self.safety.reset(0.0)
            self._u_prev = np.zeros(self._model.n)

    def _check_following(self, q: Array, arm: GuardedArm) -> None:
        """Refuse to move a commanded position that the joints do not follow."""
        if not self.space.follows_position or not np.isfinite(q).all():
            return
        errors = np.abs(q - arm.target)
        worst, limit = int(np.argmax(errors)), self.limits.following_error
        if errors[worst] > limit:
            text = f"{self._model.joints[worst].name} is {errors[worst]:.2f} rad from its commanded position"
            self._refuse(
                f"{text}, allowed are {limit:.2f}; the arm comes to rest. Remedy: look for a contact, or call `reset`"
            )

    def _current_arm(self, q: Array, v: Array) -> GuardedArm:
        """The arm at this step; an action begins at the state of its first step."""
        if self._arm is None:
            start = q if self._target is None or not self.space.follows_position else self._target
            start = start if len(start) == self._model.n else np.zeros(self._model.n)  # the pose of a base is no joint
            self._arm = GuardedArm(
                safety=self.safety, velocity_limits=self._velocity_limits, q=q, v=v, start=start, target=start
            )
            self._goal = self._read_goal(self._arm)
        return self._arm

    def _read_goal(self, arm: GuardedArm) -> ActionGoal:
        """The motion of the present action; rest without one, and for one that asks for no motion."""
        if self._values is None:
            return self.space.rest(arm)
        goal = self.space.goal(self._values, arm)
        if isinstance(goal, str):
            self._refuse(goal)
            return self.space.rest(arm)
        return goal

    def _move_target(self, arm: GuardedArm, u: Array) -> None:
        """Integrate the control of one period; the commanded configuration stays within the joint limits."""
        moved = arm.target + self._dt * u
        if self.space.follows_position:
            moved = np.clip(moved, np.minimum(self._lower, arm.target), np.maximum(self._upper, arm.target))
        arm.target, arm.elapsed = moved, arm.elapsed + self._dt
        self._target = moved if np.isfinite(moved).all() else self._target

    def _nominal(self, arm: GuardedArm, now: float) -> Array:
        """The nominal control of this step; zero after a problem."""
        assert self._goal is not None
        if self._problem:
            return np.zeros(self._model.n)
        return self._goal.control(arm, self._until - now)

    def _filter(self, q: Array, v: Array, u_nom: Array, now: float, opening: float | None) -> FilterResult:
        u_prev = None if self.space.commands_velocity else v
        if self.shadow:
            return self.shadow.evaluate(q, v, u_nom, now, u_prev=u_prev, opening=opening)
        if u_prev is not None:
            self.safety.reset(u_prev)
        if self._brakes_along_path and not self._problem:
            u_nom = self._braked(q, v, u_nom, self._u_prev if u_prev is None else u_prev, now, opening)
        result = self.safety(q, v, u_nom, now, opening=opening)
        self._u_prev = result.u
        return result

    def _braked(self, q: Array, v: Array, u_nom: Array, u_prev: Array, now: float, opening: float | None) -> Array:
        """The nominal control, slowed down along its direction as far as the barriers need it."""
        found = brake_along_path(self.safety, self._braking_step, q, v, u_nom, u_prev, now, opening)
        if found is None:
            self._speed_share = 0.0
            return u_nom
        self._speed_share = min(self._speed_share, found[1])
        return found[0]

    def _refuse(self, problem: str) -> None:
        """The first problem since the action began is reported."""
        self._problem = self._problem or problem
