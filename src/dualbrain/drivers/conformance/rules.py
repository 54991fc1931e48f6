"""The laws that every driver keeps, for authors of drivers: each is tried on a fresh, connected subject.

    assert [finding for finding in conform(make) if finding.verdict is Verdict.BROKEN] == []

or one by one, `LAWS[k].check(Trial(make()))`, which returns what was wrong, "" for nothing. The same laws hold for the
simulated arm and for the fakes; `dualbrain robot conform` runs them. **On a real arm the laws move it.**
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
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

POSITION_TOLERANCE = 2e-3
"""[rad] within which a joint is where it was sent."""
MAX_MOTION_AT_REST, MAX_SPEED_AT_REST = 1e-3, 0.01
"""[rad] that an arm at rest may move, and the speed [rad/s] below which it is at rest."""
MAX_BRAKING_TIME = 0.5
"""[s] within which a stopped arm is at rest."""
MAX_STOP_REPORT_DELAY = 0.01
"""[s] within which a stop is told."""
WATCHDOG_SLACK_PERIODS = 2.0
"""Periods that the arm's own watchdog may take longer than declared."""


class RequirementStatus(Enum):
    """What came of a law. NOT_EXAMINED: it could not be tried on this subject, which proves nothing."""

    MET = "kept"
    VIOLATED = "broken"
    NOT_TESTED = "not examined"


@dataclass(frozen=True, slots=True)
class Requirement:
    """One promise: its name, what it says, and a trial that returns what was wrong ("" for nothing)."""

    name: str
    description: str
    check: Callable[[DriverHarness], str]
    applies: Callable[[DriverUnderTest], bool] = lambda subject: True


@dataclass(frozen=True, slots=True)
class RequirementResult:
    """A law and what came of it."""

    requirement: str
    status: RequirementStatus
    reason: str = ""


def check_conformance(
    make_driver: Callable[[], DriverUnderTest], requirements: tuple[Requirement, ...] | None = None
) -> tuple[RequirementResult, ...]:
    """Try every law, each on a subject of its own; what raises has broken its law."""
    return tuple(
        _check_requirement(law, make_driver()) for law in (REQUIREMENTS if requirements is None else requirements)
    )


def _check_requirement(requirement: Requirement, under_test: DriverUnderTest) -> RequirementResult:
    try:
        if not requirement.applies(under_test):
            return RequirementResult(requirement.name, RequirementStatus.NOT_TESTED, "nothing here can provoke it")
        why = requirement.check(DriverHarness(under_test))
    except Exception as error:  # a driver never raises once it is open
        why = f"{type(error).__name__}: {error}"
    finally:
        under_test.driver.close()
    return RequirementResult(requirement.name, RequirementStatus.VIOLATED if why else RequirementStatus.MET, why)


# --- states -------------------------------------------------------------------------------------------------------


def _states_are_valid(trial: DriverHarness) -> str:
    trial.wait(20)
    for state in trial.states:
        if len(state.q) != trial.robot_model.nq or len(state.v) != trial.n:
            return f"{len(state.q)} positions and {len(state.v)} velocities for {trial.n} joints"
        numbers = np.concatenate((state.q, state.v, (state.opening, state.stamp)))
        if not np.isfinite(numbers).all():
            return f"a state that is not finite: {state}"
        for joint, q in zip(trial.robot_model.joints, state.q, strict=True):
            if not joint.lower.value <= q <= joint.upper.value:
                return f"{joint.name} at {q:.3f} rad, outside of its range"
    return ""


def _stamps_match_sequence(trial: DriverHarness) -> str:
    trial.wait(100)
    stamps = np.array([state.stamp for state in trial.states])
    numbers = np.array([state.sequence for state in trial.states])
    steps, counts = np.diff(stamps), np.diff(numbers)
    if (counts < 1).any() or (steps <= 0.0).any():
        return "a state came twice, or out of order"
    gap = float(np.abs(steps - counts * trial.period).max())
    return f"stamps and sequence numbers part by {gap * 1e3:.2f} ms" if gap > 0.1 * trial.period else ""


def _reading_is_repeatable(trial: DriverHarness) -> str:
    trial.wait(3)
    one, other = trial.driver.read(), trial.driver.read()
    if one.sequence != other.sequence or one.stamp != other.stamp or (one.q != other.q).any():
        return "reading twice within a period gives two states"
    return ""


def _states_are_immutable(trial: DriverHarness) -> str:
    if not trial.switch_on():
        return _enable_failure(trial)
    state = trial.state
    q, v = state.q.copy(), state.v.copy()
    trial.swing_joint(0, trial.inward_sign(0) * 0.1, SMALL_MOTION_TIME)
    return "a state that was handed out changed afterwards" if (state.q != q).any() or (state.v != v).any() else ""


# --- motion -------------------------------------------------------------------------------------------------------


def _waits_for_enable(trial: DriverHarness) -> str:
    trial.driver.stop()
    before = trial.driver.read().q
    if _came_on_when_commanded(trial, 0.2):
        return "the drive came on unasked"
    return _unexpected_motion(trial, before, "a command moved an arm whose drive is off")


def _rests_when_enabled(trial: DriverHarness) -> str:
    if not trial.switch_on():
        return _enable_failure(trial)
    before = trial.state.q
    trial.write(np.zeros(trial.n), trial.n_periods(0.2))
    if not trial.state.drive_enabled:
        return f"the drive went off: {trial.driver.faults()}"
    return _unexpected_motion(trial, before, "an arm that was switched on moved by itself")


def _moves_right_joint(trial: DriverHarness) -> str:
    if not trial.switch_on():
        return _enable_failure(trial)
    for joint in range(trial.n):
        before = trial.state.q.copy()
        sign = trial.inward_sign(joint)
        asked = trial.swing_joint(joint, sign * 2.0 * SMALL_MOTION / SMALL_MOTION_TIME, SMALL_MOTION_TIME)
        trial.write(np.zeros(trial.n), trial.n_periods(SETTLE_TIME))
        wanted = np.zeros(trial.n)
        wanted[joint] = asked
        moved = trial.state.q - before
        if not trial.state.drive_enabled:
            return f"the drive went off: {trial.driver.faults()}"
        if (np.abs(moved - wanted) > POSITION_TOLERANCE).any():
            return f"joint {joint + 1} asked to move {asked:+.3f} rad: all joints moved by {np.round(moved, 3)}"
    return ""


def _reaches_model_limits(trial: DriverHarness) -> str:
    """Whatever lies within the body's limits is carried out, and nothing of it is clipped on the way."""
    if not trial.switch_on():
        return _enable_failure(trial)
    for joint in range(trial.n):
        before = float(trial.state.q[joint])
        peak, seconds = trial.max_swing(joint)
        asked = trial.swing_joint(joint, trial.inward_sign(joint) * peak, seconds)
        trial.write(np.zeros(trial.n), trial.n_periods(SETTLE_TIME))
        if not trial.state.drive_enabled:
            return f"joint {joint + 1} at the body's limits: {trial.driver.faults()}"
        if abs(trial.state.q[joint] - before - asked) > 2.0 * POSITION_TOLERANCE:
            return f"joint {joint + 1} moved {trial.state.q[joint] - before:+.3f} rad instead of {asked:+.3f}"
        trial.swing_joint(joint, -float(np.sign(asked)) * peak, seconds)
        trial.write(np.zeros(trial.n), trial.n_periods(SETTLE_TIME))
    return ""


# --- stops --------------------------------------------------------------------------------------------------------


def _stops(trial: DriverHarness) -> str:
    if why := _start_motion(trial):
        return why
    trial.driver.stop()
    trial.driver.stop()
    start = trial.state.q.copy()
    trial.wait(trial.n_periods(MAX_STOP_REPORT_DELAY))
    if _came_on_when_commanded(trial, MAX_BRAKING_TIME):
        return f"the drive counts as on later than {MAX_STOP_REPORT_DELAY * 1e3:.0f} ms after a stop"
    if trial.max_joint_speed() > MAX_SPEED_AT_REST:
        return f"{trial.max_joint_speed():.3f} rad/s, {MAX_BRAKING_TIME} s after a stop"
    far = float(np.abs(trial.state.q - start).max())
    return f"{far:.3f} rad after a stop" if far > SMALL_MOTION else ""


def _discards_old_command(trial: DriverHarness) -> str:
    if why := _start_motion(trial):
        return why
    trial.driver.stop()
    trial.wait(trial.n_periods(MAX_BRAKING_TIME))
    if not trial.switch_on():
        return _enable_failure(trial)
    before = trial.state.q.copy()
    trial.write(np.zeros(trial.n), trial.n_periods(0.1))
    if not trial.state.drive_enabled:
        return f"the drive went off: {trial.driver.faults()}"
    return _unexpected_motion(trial, before, "the command from before the stop came to life again")


def _restarts_after_stop(trial: DriverHarness) -> str:
    for _ in range(3):
        if why := _start_motion(trial):
            return why
        trial.driver.stop()
        trial.wait(trial.n_periods(MAX_BRAKING_TIME))
    return ""


def _stops_without_commands(trial: DriverHarness) -> str:
    if why := _start_motion(trial):
        return why
    start, budget = trial.state.stamp, trial.driver.watchdog + WATCHDOG_SLACK_PERIODS * trial.period
    while trial.state.drive_enabled and trial.state.stamp - start < 2.0 * budget:
        stamp = trial.state.stamp
        trial.wait()
        if trial.state.drive_enabled and trial.state.stamp == stamp:
            return "states stopped coming"
    took = trial.state.stamp - start
    if trial.state.drive_enabled or took > budget:
        return f"still driven {took * 1e3:.0f} ms after the last command"
    if not trial.driver.faults():
        return "nobody said why the drive went off"
    trial.wait(trial.n_periods(MAX_BRAKING_TIME))
    return (
        "" if trial.max_joint_speed() < MAX_SPEED_AT_REST else f"{trial.max_joint_speed():.3f} rad/s after its watchdog"
    )


def _rejects_non_finite(trial: DriverHarness) -> str:
    if why := _start_motion(trial):
        return why
    for bad in (nan, inf, -inf):
        u = np.zeros(trial.n)
        u[0] = bad
        trial.write(u)
    if trial.state.drive_enabled:
        return "a command that is not finite leaves the drive on"
    trial.wait(trial.n_periods(MAX_BRAKING_TIME))
    if not np.isfinite(trial.state.q).all() or trial.max_joint_speed() > MAX_SPEED_AT_REST:
        return f"after a command that was not finite: q {trial.state.q}, {trial.max_joint_speed():.3f} rad/s"
    return ""


def _reports_vendor_stop(trial: DriverHarness) -> str:
    """The maker's own safety stops the arm: told, obeyed, left only when it is cleared and somebody enables."""
    subject = trial.under_test
    assert subject.trigger_stop
    assert subject.clear_stop
    if why := _start_motion(trial):
        return why
    subject.trigger_stop()
    trial.wait(trial.n_periods(MAX_STOP_REPORT_DELAY))
    if _came_on_when_commanded(trial, MAX_BRAKING_TIME) or not trial.driver.faults():
        return "the maker's stop was not told"
    before = trial.state.q.copy()
    if trial.switch_on():
        return "the drive came on although the maker's stop stands"
    if moved := _unexpected_motion(trial, before, "the arm moved under the maker's stop"):
        return moved
    return _stays_off_after_clear(trial, subject.clear_stop)


def _stays_off_after_clear(trial: DriverHarness, clear: Callable[[], None]) -> str:
    """Once the maker's stop is gone, the drive waits for somebody to enable it."""
    clear()
    trial.wait(3)
    if trial.state.drive_enabled:
        return "the drive came on by itself once the maker's stop was cleared"
    return "" if trial.switch_on() and not trial.driver.faults() else _enable_failure(trial)


def _closes(trial: DriverHarness) -> str:
    if why := _start_motion(trial):
        return why
    trial.driver.close()
    trial.driver.close()
    trial.driver.write(trial.make_command(np.full(trial.n, 0.05)))
    return "the drive counts as on after it was let go" if trial.driver.read().drive_enabled else ""


def _start_motion(trial: DriverHarness) -> str:
    """Bring one joint to the top of a gentle swing; "" or what went wrong."""
    if not trial.state.drive_enabled and not trial.switch_on():
        return _enable_failure(trial)
    trial.swing_joint(
        0, trial.inward_sign(0) * 2.0 * SMALL_MOTION / SMALL_MOTION_TIME, SMALL_MOTION_TIME, stop_fraction=0.5
    )
    return (
        ""
        if trial.max_joint_speed() > SMALL_MOTION / SMALL_MOTION_TIME
        else f"only {trial.max_joint_speed():.3f} rad/s: it did not get under way"
    )


def _came_on_when_commanded(trial: DriverHarness, seconds: float) -> bool:
    """Ask a drive that is off for a gentle swing; whether it was ever on meanwhile."""
    first = len(trial.states) - 1
    trial.swing_joint(0, trial.inward_sign(0) * SMALL_MOTION / SMALL_MOTION_TIME, seconds)
    return any(state.drive_enabled for state in trial.states[first:])


def _unexpected_motion(trial: DriverHarness, before: np.ndarray, what: str) -> str:
    far = float(np.abs(trial.state.q - before).max())
    return f"{what}: {far:.4f} rad" if far > MAX_MOTION_AT_REST else ""


def _enable_failure(trial: DriverHarness) -> str:
    return f"the drive did not come on within {trial.driver.timing.drive_on_timeout} s: {trial.driver.faults()}"


def _has_watchdog(subject: DriverUnderTest) -> bool:
    return isfinite(subject.driver.watchdog)


def _can_trigger_stop(subject: DriverUnderTest) -> bool:
    return subject.trigger_stop is not None and subject.clear_stop is not None


REQUIREMENTS: tuple[Requirement, ...] = (
    Requirement("sane", "states have the body's shape, are finite and in range", _states_are_valid),
    Requirement("beats", "states come once each, and stamps keep step with sequence numbers", _stamps_match_sequence),
    Requirement("reading is free", "reading twice within a period gives the same state", _reading_is_repeatable),
    Requirement("handed out", "a state that was handed out never changes", _states_are_immutable),
    Requirement("waits for enable", "no command moves an arm whose drive is off", _waits_for_enable),
    Requirement("stands when enabled", "an arm that is switched on stands", _rests_when_enabled),
    Requirement("right joint", "a velocity moves its joint, by its integral, and no other", _moves_right_joint),
    Requirement(
        "as hard as the body may", "what lies within the body's limits is carried out unclipped", _reaches_model_limits
    ),
    Requirement("stops", "a stop is told within 10 ms and ends in rest; another one changes nothing", _stops),
    Requirement("forgets", "a command from before a stop is never carried out after it", _discards_old_command),
    Requirement("goes on", "after a stop the drive comes on again, as often as one likes", _restarts_after_stop),
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
        "a stop by the arm's own safety is told and obeyed, and left only on purpose",
        _reports_vendor_stop,
        _can_trigger_stop,
    ),
    Requirement("closes", "after closing nothing moves", _closes),
)
