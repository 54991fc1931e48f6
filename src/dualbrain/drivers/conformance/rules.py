"""Requirements on every driver, for authors of drivers; each is tested on a newly connected driver.

    results = check_conformance(make_driver)
    assert not [result for result in results if result.status is RequirementStatus.VIOLATED]

A single requirement is tested by `REQUIREMENTS[k].check(DriverHarness(make_driver()))`, which returns the problem, or
"" if there is none. The same requirements hold for the simulated arm and the fakes; `dualbrain robot conform` tests
them. **On real hardware the tests move the arm.**
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from math import inf, isfinite, nan

import numpy as np

from dualbrain.drivers.conformance.harness import (
    SETTLE_TIME,
    SMALL_MOTION,
    SMALL_MOTION_TIME,
    DriverHarness,
    DriverUnderTest,
)
from dualbrain.drivers.conformance.home_posture import find_home_problem
from dualbrain.safety.cbf.obstacles import Obstacle

POSITION_TOLERANCE = 2e-3
"""Maximum position error [rad] after a motion."""
STATE_DELAY_PERIODS = 2.0
"""Periods by which a state may be older than the command before it."""
MAX_MOTION_AT_REST, MAX_SPEED_AT_REST = 1e-3, 0.01
"""Maximum motion of an arm at rest [rad], and the speed below which an arm counts as at rest [rad/s]."""
MAX_BRAKING_TIME = 0.5
"""Maximum time [s] from a stop until the arm is at rest."""
MAX_STOP_REPORT_DELAY = 0.01
"""Maximum time [s] until a stop is reported."""
WATCHDOG_SLACK_PERIODS = 2.0
"""Periods by which the watchdog of the arm may be later than declared."""


class RequirementStatus(Enum):
    """Result of a requirement. NOT_TESTED: it could not be tested on this driver, which is no evidence for it."""

    MET = "kept"
    VIOLATED = "broken"
    NOT_TESTED = "not examined"


@dataclass(frozen=True, slots=True)
class Requirement:
    """One requirement: its name, description, and a check that returns the problem ("" if there is none)."""

    name: str
    description: str
    check: Callable[[DriverHarness], str]
    applies: Callable[[DriverUnderTest], bool] = lambda under_test: True


@dataclass(frozen=True, slots=True)
class RequirementResult:
    """The result of one requirement, with the reason if it is not met."""

    requirement: str
    status: RequirementStatus
    reason: str = ""


def check_conformance(
    make_driver: Callable[[], DriverUnderTest], requirements: tuple[Requirement, ...] | None = None
) -> tuple[RequirementResult, ...]:
    """Test every requirement on a new driver from `make_driver`; an exception counts as a violation."""
    return tuple(
        _check_requirement(requirement, make_driver())
        for requirement in (REQUIREMENTS if requirements is None else requirements)
    )


def _check_requirement(requirement: Requirement, under_test: DriverUnderTest) -> RequirementResult:
    try:
        if not requirement.applies(under_test):
            reason = "it cannot be triggered on this driver"
            return RequirementResult(requirement.name, RequirementStatus.NOT_TESTED, reason)
        problem = requirement.check(DriverHarness(under_test))
    except Exception as error:  # an open driver must not raise
        problem = f"{type(error).__name__}: {error}"
    finally:
        under_test.driver.close()
    status = RequirementStatus.VIOLATED if problem else RequirementStatus.MET
    return RequirementResult(requirement.name, status, problem)


# --- states -------------------------------------------------------------------------------------------------------


def _states_are_valid(trial: DriverHarness) -> str:
    trial.wait(20)
    for state in trial.states:
        if len(state.q) != trial.robot_model.nq or len(state.v) != trial.n:
            return f"{len(state.q)} positions and {len(state.v)} velocities for {trial.n} joints"
        numbers = np.concatenate((state.q, state.v, (state.opening or 0.0, state.stamp)))
        if not np.isfinite(numbers).all():
            return f"a state is not finite: {state}"
        for joint, q in zip(trial.robot_model.joints, state.q, strict=True):
            if not joint.lower.value <= q <= joint.upper.value:
                return f"{joint.name} is at {q:.3f} rad, outside its range"
    return ""


def _stamps_match_sequence(trial: DriverHarness) -> str:
    trial.wait(100)
    stamps = np.array([state.stamp for state in trial.states])
    numbers = np.array([state.sequence for state in trial.states])
    steps, counts = np.diff(stamps), np.diff(numbers)
    if (counts < 1).any() or (steps <= 0.0).any():
        return "a state was received twice or out of order"
    deviation = float(np.abs(steps - counts * trial.period).max())
    if deviation > 0.1 * trial.period:
        return f"stamps and sequence numbers differ by {deviation * 1e3:.2f} ms"
    return ""


def _reading_is_repeatable(trial: DriverHarness) -> str:
    trial.wait(3)
    first, second = trial.driver.read(), trial.driver.read()
    if first.sequence != second.sequence or first.stamp != second.stamp or (first.q != second.q).any():
        return "two calls of read within one period return different states"
    return ""


def _states_are_immutable(trial: DriverHarness) -> str:
    if not trial.switch_on():
        return _enable_failure(trial)
    state = trial.state
    q, v = state.q.copy(), state.v.copy()
    trial.swing_joint(0, trial.inward_sign(0) * 0.1, SMALL_MOTION_TIME)
    return "a state changed after it was returned" if (state.q != q).any() or (state.v != v).any() else ""


# --- motion -------------------------------------------------------------------------------------------------------


def _waits_for_enable(trial: DriverHarness) -> str:
    trial.driver.stop()
    before = trial.driver.read().q
    if _came_on_when_commanded(trial, 0.2):
        return "the drive came on without a call of enable"
    return _unexpected_motion(trial, before, "a command moved the arm although its drive is off")


def _rests_when_enabled(trial: DriverHarness) -> str:
    if not trial.switch_on():
        return _enable_failure(trial)
    before = trial.state.q
    trial.write(np.zeros(trial.n), trial.n_periods(0.2))
    if not trial.state.drive_enabled:
        return f"the drive went off: {trial.driver.faults()}"
    return _unexpected_motion(trial, before, "the arm moved by itself after it was enabled")


def _moves_right_joint(trial: DriverHarness) -> str:
    if not trial.switch_on():
        return _enable_failure(trial)
    for joint in range(trial.n):
        before = trial.state.q.copy()
        sign = trial.inward_sign(joint)
        commanded = trial.swing_joint(joint, sign * 2.0 * SMALL_MOTION / SMALL_MOTION_TIME, SMALL_MOTION_TIME)
        trial.write(np.zeros(trial.n), trial.n_periods(SETTLE_TIME))
        expected = np.zeros(trial.n)
        expected[joint] = commanded
        moved = trial.state.q - before
        if not trial.state.drive_enabled:
            return f"the drive went off: {trial.driver.faults()}"
        if (np.abs(moved - expected) > POSITION_TOLERANCE).any():
            return (
                f"joint {joint + 1} was commanded to move {commanded:+.3f} rad, "
                f"but the joints moved by {np.round(moved, 3)}"
            )
    return ""


def _reaches_model_limits(trial: DriverHarness) -> str:
    """A command within the limits of the robot model is executed without clipping."""
    if not trial.switch_on():
        return _enable_failure(trial)
    for joint in range(trial.n):
        before = float(trial.state.q[joint])
        peak, seconds = trial.max_swing(joint)
        commanded = trial.swing_joint(joint, trial.inward_sign(joint) * peak, seconds)
        trial.write(np.zeros(trial.n), trial.n_periods(SETTLE_TIME))
        if not trial.state.drive_enabled:
            return f"the drive went off with joint {joint + 1} at the limits of the model: {trial.driver.faults()}"
        if abs(trial.state.q[joint] - before - commanded) > 2.0 * POSITION_TOLERANCE:
            return f"joint {joint + 1} moved {trial.state.q[joint] - before:+.3f} rad instead of {commanded:+.3f}"
        trial.swing_joint(joint, -float(np.sign(commanded)) * peak, seconds)
        trial.write(np.zeros(trial.n), trial.n_periods(SETTLE_TIME))
    return ""


def _follows_position(trial: DriverHarness) -> str:
    """The joints stay within the declared tracking error of the integrated command, also while they move."""
    if not trial.switch_on():
        return _enable_failure(trial)
    for joint, declared in enumerate(trial.robot_model.tracking.position_errors(trial.n)):
        peak, seconds = trial.max_swing(joint)
        for sign in (trial.inward_sign(joint), -trial.inward_sign(joint)):
            before, first = float(trial.state.q[joint]), len(trial.written)
            trial.swing_joint(joint, sign * peak, seconds)
            trial.write(np.zeros(trial.n), trial.n_periods(SETTLE_TIME))
            if not trial.state.drive_enabled:
                return f"the drive went off: {trial.driver.faults()}"
            error = _largest_position_error(trial, joint, first, before)
            if error > declared + STATE_DELAY_PERIODS * trial.period * peak + POSITION_TOLERANCE:
                return (
                    f"joint {joint + 1} was up to {error:.4f} rad from the integral of its commands; the robot model "
                    f"declares {declared:.4f} rad"
                )
    return ""


def _largest_position_error(trial: DriverHarness, joint: int, first: int, before: float) -> float:
    """The largest |q + lag v − q_0 − ∫u dt| [rad] of a joint since the command with the index `first`."""
    lag, integral, largest = trial.robot_model.tracking.lag, before, 0.0
    for u, state in trial.written[first:]:
        integral += float(u[joint]) * trial.period
        largest = max(largest, abs(float(state.q[joint] + lag * state.v[joint]) - integral))
    return largest


# --- stops --------------------------------------------------------------------------------------------------------


def _stops(trial: DriverHarness) -> str:
    if problem := _start_motion(trial):
        return problem
    trial.driver.stop()
    trial.driver.stop()
    start = trial.state.q.copy()
    trial.wait(trial.n_periods(MAX_STOP_REPORT_DELAY))
    if _came_on_when_commanded(trial, MAX_BRAKING_TIME):
        return f"the drive was reported as on more than {MAX_STOP_REPORT_DELAY * 1e3:.0f} ms after a stop"
    if trial.max_joint_speed() > MAX_SPEED_AT_REST:
        return f"a joint moved at {trial.max_joint_speed():.3f} rad/s, {MAX_BRAKING_TIME} s after a stop"
    travel = float(np.abs(trial.state.q - start).max())
    return f"a joint moved by {travel:.3f} rad after a stop" if travel > SMALL_MOTION else ""


def _discards_old_command(trial: DriverHarness) -> str:
    if problem := _start_motion(trial):
        return problem
    trial.driver.stop()
    trial.wait(trial.n_periods(MAX_BRAKING_TIME))
    if not trial.switch_on():
        return _enable_failure(trial)
    before = trial.state.q.copy()
    trial.write(np.zeros(trial.n), trial.n_periods(0.1))
    if not trial.state.drive_enabled:
        return f"the drive went off: {trial.driver.faults()}"
    return _unexpected_motion(trial, before, "a command from before the stop was executed after it")


def _restarts_after_stop(trial: DriverHarness) -> str:
    for _ in range(3):
        if problem := _start_motion(trial):
            return problem
        trial.driver.stop()
        trial.wait(trial.n_periods(MAX_BRAKING_TIME))
    return ""


def _stops_without_commands(trial: DriverHarness) -> str:
    if problem := _start_motion(trial):
        return problem
    start, budget = trial.state.stamp, trial.driver.watchdog + WATCHDOG_SLACK_PERIODS * trial.period
    while trial.state.drive_enabled and trial.state.stamp - start < 2.0 * budget:
        stamp = trial.state.stamp
        trial.wait()
        if trial.state.drive_enabled and trial.state.stamp == stamp:
            return "no new states were received"
    elapsed = trial.state.stamp - start
    if trial.state.drive_enabled or elapsed > budget:
        return f"the drive was still on {elapsed * 1e3:.0f} ms after the last command"
    if not trial.driver.faults():
        return "the driver reported no reason why the drive went off"
    trial.wait(trial.n_periods(MAX_BRAKING_TIME))
    if trial.max_joint_speed() < MAX_SPEED_AT_REST:
        return ""
    return f"a joint moved at {trial.max_joint_speed():.3f} rad/s after the stop by the watchdog"


def _rejects_non_finite(trial: DriverHarness) -> str:
    if problem := _start_motion(trial):
        return problem
    for value in (nan, inf, -inf):
        u = np.zeros(trial.n)
        u[0] = value
        trial.write(u)
    if trial.state.drive_enabled:
        return "the drive is still on after a command that is not finite"
    trial.wait(trial.n_periods(MAX_BRAKING_TIME))
    if not np.isfinite(trial.state.q).all() or trial.max_joint_speed() > MAX_SPEED_AT_REST:
        return f"after a command that is not finite: q {trial.state.q}, {trial.max_joint_speed():.3f} rad/s"
    return ""


def _reports_vendor_stop(trial: DriverHarness) -> str:
    """A stop by the safety system of the arm is reported and obeyed, until it is cleared and the drive is enabled."""
    under_test = trial.under_test
    assert under_test.trigger_stop
    assert under_test.clear_stop
    if problem := _start_motion(trial):
        return problem
    under_test.trigger_stop()
    trial.wait(trial.n_periods(MAX_STOP_REPORT_DELAY))
    if _came_on_when_commanded(trial, MAX_BRAKING_TIME) or not trial.driver.faults():
        return "the safety stop of the arm was not reported"
    before = trial.state.q.copy()
    if trial.switch_on():
        return "the drive came on although the safety stop of the arm was not cleared"
    if problem := _unexpected_motion(trial, before, "the arm moved during its safety stop"):
        return problem
    return _stays_off_after_clear(trial, under_test.clear_stop)


def _stays_off_after_clear(trial: DriverHarness, clear_stop: Callable[[], None]) -> str:
    """After a safety stop was cleared, the drive stays off until it is enabled."""
    clear_stop()
    trial.wait(3)
    if trial.state.drive_enabled:
        return "the drive came on by itself when the safety stop was cleared"
    return "" if trial.switch_on() and not trial.driver.faults() else _enable_failure(trial)


def _closes(trial: DriverHarness) -> str:
    if problem := _start_motion(trial):
        return problem
    trial.driver.close()
    trial.driver.close()
    trial.driver.write(trial.make_command(np.full(trial.n, 0.05)))
    return "the drive was reported as on after close" if trial.driver.read().drive_enabled else ""


def _start_motion(trial: DriverHarness) -> str:
    """Move one joint up to the peak of a slow swing; returns the problem, or ""."""
    if not trial.state.drive_enabled and not trial.switch_on():
        return _enable_failure(trial)
    trial.swing_joint(
        0, trial.inward_sign(0) * 2.0 * SMALL_MOTION / SMALL_MOTION_TIME, SMALL_MOTION_TIME, stop_fraction=0.5
    )
    if trial.max_joint_speed() > SMALL_MOTION / SMALL_MOTION_TIME:
        return ""
    return f"the commanded joint reached only {trial.max_joint_speed():.3f} rad/s"


def _came_on_when_commanded(trial: DriverHarness, seconds: float) -> bool:
    """Command a slow swing while the drive is off; whether the drive was on at any time."""
    first = len(trial.states) - 1
    trial.swing_joint(0, trial.inward_sign(0) * SMALL_MOTION / SMALL_MOTION_TIME, seconds)
    return any(state.drive_enabled for state in trial.states[first:])


def _unexpected_motion(trial: DriverHarness, before: np.ndarray, problem: str) -> str:
    motion = float(np.abs(trial.state.q - before).max())
    return f"{problem}: {motion:.4f} rad" if motion > MAX_MOTION_AT_REST else ""


def _enable_failure(trial: DriverHarness) -> str:
    return f"the drive did not come on within {trial.driver.timing.drive_on_timeout} s: {trial.driver.faults()}"


def _is_arm(under_test: DriverUnderTest) -> bool:
    return not under_test.robot_model.is_mobile


def _has_watchdog(under_test: DriverUnderTest) -> bool:
    return isfinite(under_test.driver.watchdog)


def _can_trigger_stop(under_test: DriverUnderTest) -> bool:
    return under_test.trigger_stop is not None and under_test.clear_stop is not None


HOME = "home"


def make_requirements(obstacles: Sequence[Obstacle]) -> tuple[Requirement, ...]:
    """All requirements, with a home posture that is also clear of the `obstacles` of a site."""
    return tuple(replace(one, check=_home_check(obstacles)) if one.name == HOME else one for one in REQUIREMENTS)


def _home_check(obstacles: Sequence[Obstacle]) -> Callable[[DriverHarness], str]:
    return lambda trial: find_home_problem(trial.robot_model, obstacles)


REQUIREMENTS: tuple[Requirement, ...] = (
    Requirement(
        HOME,
        "the home posture is within the joint limits, free of self-collision, and clear of the site",
        _home_check(()),
    ),
    Requirement("sane", "states have one value per joint, are finite and within the range", _states_are_valid),
    Requirement("beats", "every state comes once, and its stamp agrees with its number", _stamps_match_sequence),
    Requirement("reading is free", "reading twice within a period gives the same state", _reading_is_repeatable),
    Requirement("handed out", "a state does not change after it was returned", _states_are_immutable),
    Requirement("waits for enable", "no command moves an arm whose drive is off", _waits_for_enable),
    Requirement("stands when enabled", "the arm does not move when it is enabled", _rests_when_enabled),
    Requirement("right joint", "a velocity moves its joint by its integral, and no other joint", _moves_right_joint),
    Requirement(
        "as hard as the body may",
        "a command within the limits of the robot model is executed without clipping",
        _reaches_model_limits,
    ),
    Requirement(
        "follows",
        "in motion the joints stay within the tracking error of the robot model from the integral of their commands",
        _follows_position,
        _is_arm,
    ),
    Requirement("stops", "a stop is reported within 10 ms and brings the arm to rest; it may be repeated", _stops),
    Requirement("forgets", "a command from before a stop is never executed after it", _discards_old_command),
    Requirement("goes on", "after every stop the drive can be enabled again", _restarts_after_stop),
    Requirement(
        "silence",
        "without commands the arm stops by itself within the declared time",
        _stops_without_commands,
        _has_watchdog,
    ),
    Requirement(
        "rubbish", "a command that is not finite ends the motion and never reaches the arm", _rejects_non_finite
    ),
    Requirement(
        "maker's stop",
        "a stop by the safety system of the arm is reported and obeyed until it is cleared and the drive is enabled",
        _reports_vendor_stop,
        _can_trigger_stop,
    ),
    Requirement("closes", "a closed driver moves nothing", _closes),
)
"""All requirements; their names are keys of the output of `dualbrain robot conform --json`."""
