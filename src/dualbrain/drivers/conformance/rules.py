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

from dualbrain.drivers.conformance.harness import GENTLE, GENTLE_TIME, SETTLE, Subject, Trial

NEAR = 2e-3
"""[rad] within which a joint is where it was sent."""
STILL, AT_REST = 1e-3, 0.01
"""[rad] that an arm at rest may move, and the speed [rad/s] below which it is at rest."""
BRAKED = 0.5
"""[s] within which a stopped arm is at rest."""
OFF = 0.01
"""[s] within which a stop is told."""
SLACK = 2.0
"""Periods that the arm's own watchdog may take longer than declared."""


class Verdict(Enum):
    """What came of a law. NOT_EXAMINED: it could not be tried on this subject, which proves nothing."""

    KEPT = "kept"
    BROKEN = "broken"
    NOT_EXAMINED = "not examined"


@dataclass(frozen=True, slots=True)
class Law:
    """One promise: its name, what it says, and a trial that returns what was wrong ("" for nothing)."""

    name: str
    says: str
    check: Callable[[Trial], str]
    applies: Callable[[Subject], bool] = lambda subject: True


@dataclass(frozen=True, slots=True)
class Finding:
    """A law and what came of it."""

    law: str
    verdict: Verdict
    why: str = ""


def conform(make: Callable[[], Subject], laws: tuple[Law, ...] | None = None) -> tuple[Finding, ...]:
    """Try every law, each on a subject of its own; what raises has broken its law."""
    return tuple(_tried(law, make()) for law in (LAWS if laws is None else laws))


def _tried(law: Law, subject: Subject) -> Finding:
    try:
        if not law.applies(subject):
            return Finding(law.name, Verdict.NOT_EXAMINED, "nothing here can provoke it")
        why = law.check(Trial(subject))
    except Exception as error:  # a driver never raises once it is open
        why = f"{type(error).__name__}: {error}"
    finally:
        subject.driver.close()
    return Finding(law.name, Verdict.BROKEN if why else Verdict.KEPT, why)


# --- states -------------------------------------------------------------------------------------------------------


def _sane(trial: Trial) -> str:
    trial.wait(20)
    for state in trial.states:
        if len(state.q) != trial.body.width or len(state.v) != trial.n:
            return f"{len(state.q)} positions and {len(state.v)} velocities for {trial.n} joints"
        numbers = np.concatenate((state.q, state.v, (state.opening, state.stamp)))
        if not np.isfinite(numbers).all():
            return f"a state that is not finite: {state}"
        for joint, q in zip(trial.body.joints, state.q, strict=True):
            if not joint.lower.value <= q <= joint.upper.value:
                return f"{joint.name} at {q:.3f} rad, outside of its range"
    return ""


def _beats(trial: Trial) -> str:
    trial.wait(100)
    stamps = np.array([state.stamp for state in trial.states])
    numbers = np.array([state.sequence for state in trial.states])
    steps, counts = np.diff(stamps), np.diff(numbers)
    if (counts < 1).any() or (steps <= 0.0).any():
        return "a state came twice, or out of order"
    gap = float(np.abs(steps - counts * trial.period).max())
    return f"stamps and sequence numbers part by {gap * 1e3:.2f} ms" if gap > 0.1 * trial.period else ""


def _reading_is_free(trial: Trial) -> str:
    trial.wait(3)
    one, other = trial.driver.read(), trial.driver.read()
    if one.sequence != other.sequence or one.stamp != other.stamp or (one.q != other.q).any():
        return "reading twice within a period gives two states"
    return ""


def _handed_out(trial: Trial) -> str:
    if not trial.on():
        return _not_on(trial)
    state = trial.state
    q, v = state.q.copy(), state.v.copy()
    trial.swing(0, trial.inward(0) * 0.1, GENTLE_TIME)
    return "a state that was handed out changed afterwards" if (state.q != q).any() or (state.v != v).any() else ""


# --- motion -------------------------------------------------------------------------------------------------------


def _waits_for_enable(trial: Trial) -> str:
    trial.driver.stop()
    before = trial.driver.read().q
    if _nudged(trial, 0.2):
        return "the drive came on unasked"
    return _moved(trial, before, "a command moved an arm whose drive is off")


def _stands_when_enabled(trial: Trial) -> str:
    if not trial.on():
        return _not_on(trial)
    before = trial.state.q
    trial.write(np.zeros(trial.n), trial.count(0.2))
    if not trial.state.drive_enabled:
        return f"the drive went off: {trial.driver.faults()}"
    return _moved(trial, before, "an arm that was switched on moved by itself")


def _right_joint(trial: Trial) -> str:
    if not trial.on():
        return _not_on(trial)
    for joint in range(trial.n):
        before = trial.state.q.copy()
        sign = trial.inward(joint)
        asked = trial.swing(joint, sign * 2.0 * GENTLE / GENTLE_TIME, GENTLE_TIME)
        trial.write(np.zeros(trial.n), trial.count(SETTLE))
        wanted = np.zeros(trial.n)
        wanted[joint] = asked
        moved = trial.state.q - before
        if not trial.state.drive_enabled:
            return f"the drive went off: {trial.driver.faults()}"
        if (np.abs(moved - wanted) > NEAR).any():
            return f"joint {joint + 1} asked to move {asked:+.3f} rad: all joints moved by {np.round(moved, 3)}"
    return ""


def _as_hard_as_the_body_may(trial: Trial) -> str:
    """Whatever lies within the body's limits is carried out, and nothing of it is clipped on the way."""
    if not trial.on():
        return _not_on(trial)
    for joint in range(trial.n):
        before = float(trial.state.q[joint])
        peak, seconds = trial.hardest(joint)
        asked = trial.swing(joint, trial.inward(joint) * peak, seconds)
        trial.write(np.zeros(trial.n), trial.count(SETTLE))
        if not trial.state.drive_enabled:
            return f"joint {joint + 1} at the body's limits: {trial.driver.faults()}"
        if abs(trial.state.q[joint] - before - asked) > 2.0 * NEAR:
            return f"joint {joint + 1} moved {trial.state.q[joint] - before:+.3f} rad instead of {asked:+.3f}"
        trial.swing(joint, -float(np.sign(asked)) * peak, seconds)
        trial.write(np.zeros(trial.n), trial.count(SETTLE))
    return ""


# --- stops --------------------------------------------------------------------------------------------------------


def _stops(trial: Trial) -> str:
    if why := _under_way(trial):
        return why
    trial.driver.stop()
    trial.driver.stop()
    start = trial.state.q.copy()
    trial.wait(trial.count(OFF))
    if _nudged(trial, BRAKED):
        return f"the drive counts as on later than {OFF * 1e3:.0f} ms after a stop"
    if trial.speed() > AT_REST:
        return f"{trial.speed():.3f} rad/s, {BRAKED} s after a stop"
    far = float(np.abs(trial.state.q - start).max())
    return f"{far:.3f} rad after a stop" if far > GENTLE else ""


def _forgets(trial: Trial) -> str:
    if why := _under_way(trial):
        return why
    trial.driver.stop()
    trial.wait(trial.count(BRAKED))
    if not trial.on():
        return _not_on(trial)
    before = trial.state.q.copy()
    trial.write(np.zeros(trial.n), trial.count(0.1))
    if not trial.state.drive_enabled:
        return f"the drive went off: {trial.driver.faults()}"
    return _moved(trial, before, "the command from before the stop came to life again")


def _goes_on_after_a_stop(trial: Trial) -> str:
    for _ in range(3):
        if why := _under_way(trial):
            return why
        trial.driver.stop()
        trial.wait(trial.count(BRAKED))
    return ""


def _silence(trial: Trial) -> str:
    if why := _under_way(trial):
        return why
    start, budget = trial.state.stamp, trial.driver.watchdog + SLACK * trial.period
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
    trial.wait(trial.count(BRAKED))
    return "" if trial.speed() < AT_REST else f"{trial.speed():.3f} rad/s after its watchdog"


def _rubbish(trial: Trial) -> str:
    if why := _under_way(trial):
        return why
    for bad in (nan, inf, -inf):
        u = np.zeros(trial.n)
        u[0] = bad
        trial.write(u)
    if trial.state.drive_enabled:
        return "a command that is not finite leaves the drive on"
    trial.wait(trial.count(BRAKED))
    if not np.isfinite(trial.state.q).all() or trial.speed() > AT_REST:
        return f"after a command that was not finite: q {trial.state.q}, {trial.speed():.3f} rad/s"
    return ""


def _vendor_stop(trial: Trial) -> str:
    """The maker's own safety stops the arm: told, obeyed, left only when it is cleared and somebody enables."""
    subject = trial.subject
    assert subject.provoke
    assert subject.clear
    if why := _under_way(trial):
        return why
    subject.provoke()
    trial.wait(trial.count(OFF))
    if _nudged(trial, BRAKED) or not trial.driver.faults():
        return "the maker's stop was not told"
    before = trial.state.q.copy()
    if trial.on():
        return "the drive came on although the maker's stop stands"
    if moved := _moved(trial, before, "the arm moved under the maker's stop"):
        return moved
    return _cleared(trial, subject.clear)


def _cleared(trial: Trial, clear: Callable[[], None]) -> str:
    """Once the maker's stop is gone, the drive waits for somebody to enable it."""
    clear()
    trial.wait(3)
    if trial.state.drive_enabled:
        return "the drive came on by itself once the maker's stop was cleared"
    return "" if trial.on() and not trial.driver.faults() else _not_on(trial)


def _closes(trial: Trial) -> str:
    if why := _under_way(trial):
        return why
    trial.driver.close()
    trial.driver.close()
    trial.driver.write(trial.command(np.full(trial.n, 0.05)))
    return "the drive counts as on after it was let go" if trial.driver.read().drive_enabled else ""


def _under_way(trial: Trial) -> str:
    """Bring one joint to the top of a gentle swing; "" or what went wrong."""
    if not trial.state.drive_enabled and not trial.on():
        return _not_on(trial)
    trial.swing(0, trial.inward(0) * 2.0 * GENTLE / GENTLE_TIME, GENTLE_TIME, until=0.5)
    return "" if trial.speed() > GENTLE / GENTLE_TIME else f"only {trial.speed():.3f} rad/s: it did not get under way"


def _nudged(trial: Trial, seconds: float) -> bool:
    """Ask a drive that is off for a gentle swing; whether it was ever on meanwhile."""
    first = len(trial.states) - 1
    trial.swing(0, trial.inward(0) * GENTLE / GENTLE_TIME, seconds)
    return any(state.drive_enabled for state in trial.states[first:])


def _moved(trial: Trial, before: np.ndarray, what: str) -> str:
    far = float(np.abs(trial.state.q - before).max())
    return f"{what}: {far:.4f} rad" if far > STILL else ""


def _not_on(trial: Trial) -> str:
    return f"the drive did not come on within {trial.driver.timing.switching} s: {trial.driver.faults()}"


def _watched(subject: Subject) -> bool:
    return isfinite(subject.driver.watchdog)


def _provocable(subject: Subject) -> bool:
    return subject.provoke is not None and subject.clear is not None


LAWS: tuple[Law, ...] = (
    Law("sane", "states have the body's shape, are finite and in range", _sane),
    Law("beats", "states come once each, and stamps keep step with sequence numbers", _beats),
    Law("reading is free", "reading twice within a period gives the same state", _reading_is_free),
    Law("handed out", "a state that was handed out never changes", _handed_out),
    Law("waits for enable", "no command moves an arm whose drive is off", _waits_for_enable),
    Law("stands when enabled", "an arm that is switched on stands", _stands_when_enabled),
    Law("right joint", "a velocity moves its joint, by its integral, and no other", _right_joint),
    Law("as hard as the body may", "what lies within the body's limits is carried out unclipped",
        _as_hard_as_the_body_may),
    Law("stops", "a stop is told within 10 ms and ends in rest; another one changes nothing", _stops),
    Law("forgets", "a command from before a stop is never carried out after it", _forgets),
    Law("goes on", "after a stop the drive comes on again, as often as one likes", _goes_on_after_a_stop),
    Law("silence", "without commands the arm stops by itself within the declared time", _silence, _watched),
    Law("rubbish", "a command that is not finite ends the motion and never reaches the arm", _rubbish),
    Law("maker's stop", "a stop by the arm's own safety is told and obeyed, and left only on purpose", _vendor_stop,
        _provocable),
    Law("closes", "after closing nothing moves", _closes),
)  # fmt: skip
