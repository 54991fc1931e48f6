"""One flight: a policy's wishes go to the suite as they are, or through the filter; what it became, as a row."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Pose
from dualbrain.robots.loader import load_body
from dualbrain.robots.model import Body
from dualbrain.safety.cbf.filter import SafetyFilter, Status, ToolState
from dualbrain.simulation.identification.excitation import Log
from dualbrain.simulation.identification.tracking_model import leaky_error
from experiments.robots.robosuite.policies import PACES, TASKS, BangBang, Policy, Script
from experiments.robots.robosuite.scene import Watch, standing
from experiments.robots.robosuite.suite_process import Opened, State, Suite
from experiments.robots.robosuite.tracking import disagreement, measured

Array = NDArray[np.float64]

LONGEST = 30.0
"""A flight ends after this at the latest [s]."""
ANYWHERE = 5.0
"""How long a policy without a task flies [s]."""
LOOK = 10
"""Periods between looks at the cubes."""
CALIBRATION = (1000, 1001)
"""Seeds of the flights that tracking is measured in."""
FASTEST = np.array([joint.velocity.value for joint in load_body("panda").joints])
"""The data sheet's joint velocities [rad/s], which policies know."""
OTHER, SETTING_DOWN = "cubeB", ("lower", "open", "away")
"""A cube that nothing should push, until the first one is set down on it."""
HOWS = ("unfiltered", "clipped", "filtered")
"""The wish as it is; each joint cut to the velocity limit that the filter is told of; through the filter."""


@dataclass
class Course:
    """What happened, period by period, and at the end."""

    q: list[Array] = field(default_factory=list)
    v: list[Array] = field(default_factory=list)
    u: list[Array] = field(default_factory=list)
    delta: list[float] = field(default_factory=list)
    status: list[int] = field(default_factory=list)
    h_min: float = float("inf")
    apart: float = 0.0
    pushed: float = 0.0
    time: float = 0.0
    ended: str = ""

    def log(self) -> Log:
        """What tracking is measured from."""
        return Log(np.array(self.q), np.array(self.v), np.array(self.u))

    def figures(self, body: Body) -> dict[str, Any]:
        """Times [s], shares of the data sheet's speed, the tracking error's leaky integral [rad], the filter's part."""
        log, tracking = self.log(), body.tracking
        error = leaky_error(log, tracking.lag, tracking.rate, body.period)
        found: dict[str, Any] = {
            "time": round(self.time, 3), "ended": self.ended, "pushed": round(self.pushed, 5), "apart": self.apart,
            "asked": round(float(np.max(np.abs(log.u) / FASTEST)), 4),
            "speed": round(float(np.max(np.abs(log.v) / FASTEST)), 4),
            "strayed": round(float(np.abs(error).max()), 7), "steps": len(log.u),
        }  # fmt: skip
        if self.status:
            found |= {
                "delta": round(float(np.mean(self.delta)), 6), "h_min": round(self.h_min, 6),
                "status": np.bincount(self.status, minlength=len(Status)).tolist(),
            }  # fmt: skip
        return found


class Pilot:
    """Turns wishes into what is sent."""

    def __init__(self, how: str, safety: SafetyFilter, watch: Watch) -> None:
        self._how, self._safety, self._watch = how, safety, watch
        self._told = np.array([joint.velocity.value for joint in safety.body.joints])
        self.course = Course()

    def u(self, state: State, tool: ToolState, policy: Policy, wish: Array) -> Array:
        """Joint velocities (n,) [rad/s] to be sent."""
        course, u = self.course, wish
        if self._how == "clipped":
            u = np.clip(wish, -self._told, self._told)
        if self._how == "filtered":
            if len(course.u) % LOOK == 0:
                self._watch.look(state, tool, policy.point)
            answer = self._safety(state.q, state.v, wish, state.time, state.opening)
            u = answer.u
            course.delta.append(answer.delta)
            course.status.append(int(answer.status))
            course.h_min = min(course.h_min, answer.h_min)
        course.q.append(state.q)
        course.v.append(state.v)
        course.u.append(u)
        return u


def body_of(suite: Suite) -> Body:
    """The body that the filter is told of: the suite's period, its motors, and how its arm was seen to follow."""

    def flights(body: Body) -> list[list[Log]]:
        return [
            [_flown(suite, body, {"task": task, "policy": policy, "seed": seed, "how": "filtered"}).log()
             for task in TASKS for policy in PACES]
            for seed in CALIBRATION
        ]  # fmt: skip

    return measured(suite, flights)


def fly(suite: Suite, body: Body, about: dict[str, Any]) -> dict[str, Any]:
    """One flight of `about` (task, policy, seed, how), from the suite's own start to the script's end."""
    course = _flown(suite, body, about)
    return {
        **about, **suite.account(), **course.figures(body), "lag": body.tracking.lag,
        "allowed_error": body.tracking.position_error, "versions": suite.versions,
    }  # fmt: skip


def _flown(suite: Suite, body: Body, about: dict[str, Any]) -> Course:
    opened = suite.open(about["task"], about["seed"])
    safety = SafetyFilter(body, standing=standing(opened.things))
    apart, _ = disagreement(suite, safety, np.random.default_rng(about["seed"]))
    state = suite.read(opened.state)
    policy = _policy(about, opened, state)
    pilot = Pilot(about["how"], safety, Watch(safety, opened.things))
    course, begin = pilot.course, state.cubes
    course.apart = apart
    while not policy.done and state.time < LONGEST:
        tool = safety.tool(state.q)
        wish = policy.wish(state.time, state.q, tool, state.cubes)
        state = suite.step(pilot.u(state, tool, policy, wish), policy.point.closed)
        if policy.point.name not in SETTING_DOWN and OTHER in begin:
            course.pushed = max(course.pushed, _moved(begin[OTHER], state.cubes[OTHER]))
    course.time, course.ended = state.time, "" if policy.done else policy.point.name
    return course


def _moved(before: Pose, after: Pose) -> float:
    """How far a thing has been pushed in the plane [m]."""
    return float(np.linalg.norm(np.array(after.position)[:2] - np.array(before.position)[:2]))


def _policy(about: dict[str, Any], opened: Opened, state: State) -> Policy:
    if about["policy"] == "random":
        return BangBang(FASTEST, opened.cubes[0], about["seed"], ANYWHERE)
    points = TASKS[about["task"]](about["policy"] == "hasty")
    return Script(points, PACES[about["policy"]], FASTEST, state.q, opened.period)
