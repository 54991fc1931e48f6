"""The joint state of the newest observation of an embodiment, and whether it is still usable."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite
from typing import Any

import numpy as np
from inspect_robots.types import Observation
from numpy.typing import NDArray

from inspect_robots_dualbrain.joint_map import JointMap

Array = NDArray[np.float64]
FASTEST_LOOP = 0.5
"""Smallest time between two stamped observations, as a share of the period of the embodiment."""


@dataclass(frozen=True, slots=True, kw_only=True)
class JointState:
    """Joint positions and velocities `q`, `v` (n,) [rad, rad/s] at `now` [s] since the episode began.

    `problem`: why they cannot be used, with a remedy; "" if they can. Then unknown values are NaN.
    """

    q: Array
    v: Array
    now: float
    problem: str = ""


class JointStateReader:
    """Reads the joint state from observations; each one serves one action.

    The time of an episode is that of the stamps (`state_time`) if the embodiment sets them; else it advances by the
    period. Without reported velocities they are the difference quotient of the positions.
    """

    def __init__(self, joints: JointMap, *, period: float, max_age: float | None, clock: Callable[[], float]) -> None:
        """Read with `joints`; `period` [s] is the time of one action.

        A state that is older than `max_age` [s] on `clock` is stale; None: it does not age, as in a simulator that
        waits for the policy.
        """
        self._joints, self._period, self._max_age, self._clock = joints, period, max_age, clock
        self.observation: Observation | None = None
        self._begin()

    def _begin(self) -> None:
        self._unknown = np.full(len(self._joints.entries), np.nan)
        self._state = JointState(
            q=self._unknown, v=self._unknown, now=0.0, problem=_stopping("There is no observation yet", "call `reset`")
        )
        self._q, self._stamp, self._received, self._is_used = self._unknown, 0.0, 0.0, False

    def begin(self, observation: Observation) -> None:
        """Begin an episode with the `observation` of the reset."""
        self._begin()
        self._stamp = _stamp_of(observation)
        self._note(observation, 0.0, "")

    def update(self, observation: Observation) -> None:
        """Take the `observation` after a step."""
        stamp, before = _stamp_of(observation), self._stamp
        self._stamp = stamp
        elapsed = stamp - before if stamp or before else self._period
        self._note(observation, max(elapsed, self._period) if isfinite(elapsed) else self._period, self._late(elapsed))

    def take(self) -> JointState:
        """The joint state for one action; it has a problem if it is missing, stale or was taken before."""
        state, is_used, self._is_used = self._state, self._is_used, True
        age = self._clock() - self._received
        problem = state.problem
        if is_used:
            problem = problem or _stopping("There is no observation since the last action", "call `step` in between")
            state = self._state = JointState(q=state.q, v=state.v, now=state.now + self._period, problem=state.problem)
        elif self._max_age is not None and age > self._max_age and not problem:
            remedy = "let the policy return several actions per inference, or raise guard_max_state_age"
            problem = _stopping(f"The joint state is {age:.2f} s old, allowed are {self._max_age:g} s", remedy)
        return JointState(q=state.q, v=state.v, now=state.now, problem=problem)

    def _note(self, observation: Observation, elapsed: float, problem: str) -> None:
        q = self._joints.positions(observation.state)
        v = self._joints.velocities(observation.state)
        for found in (q, v):
            if isinstance(found, str) and not problem:
                problem = _stopping(
                    f"{found[0].upper()}{found[1:]}", "check the sensors and the state of the embodiment"
                )
        known_q = self._unknown if isinstance(q, str) else q
        self._state = JointState(
            q=known_q,
            v=self._difference(known_q, elapsed) if v is None else self._unknown if isinstance(v, str) else v,
            now=self._state.now + elapsed,
            problem=problem,
        )
        self._q, self.observation = known_q, observation
        self._received, self._is_used = self._clock(), False

    def _difference(self, q: Array, elapsed: float) -> Array:
        """The mean velocity since the last observation; zero after a reset."""
        if elapsed == 0.0 or not np.isfinite(self._q).all():
            return np.zeros_like(q)
        return (q - self._q) / elapsed

    def _late(self, elapsed: float) -> str:
        """Why the time `elapsed` [s] between two stamps contradicts the period; "" if it does not."""
        remedy = "check that the embodiment reads its joints in every step, with one monotonic clock"
        if elapsed > FASTEST_LOOP * self._period:
            return ""
        if elapsed > 0.0:
            text = f"A step took {elapsed:.4f} s, but control_hz promises {self._period:.4f} s"
            return _stopping(text, "pace `step` of the embodiment, or declare its true control_hz")
        if elapsed == 0.0:
            return _stopping("The state of the observation is as old as that of the last one", remedy)
        return _stopping("The stamp of the state is not after that of the last observation", remedy)


def _stamp_of(observation: Observation) -> float:
    """The time of the state [s]; 0 if the embodiment does not set it."""
    stamp: Any = observation.state_time
    try:
        return float(stamp)
    except (TypeError, ValueError):
        return float("nan")


def _stopping(cause: str, remedy: str) -> str:
    return f"{cause}; the arm comes to rest. Remedy: {remedy}"
