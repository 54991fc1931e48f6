"""One flight: a policy's wishes go to the suite as they are, or through the filter; what it became, as a row."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Pose
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.filter import FilterStatus, SafetyFilter, ToolState
from dualbrain.simulation.identification.excitation import ExcitationLog
from dualbrain.simulation.identification.tracking_model import leaky_error
from experiments.robots.robosuite.policies import SPEED_PROFILES, TASKS, BangBangPolicy, Policy, WaypointPolicy
from experiments.robots.robosuite.scene import ObstacleTracker, static_obstacles
from experiments.robots.robosuite.suite_process import State, SuiteProcess, TaskSetup
from experiments.robots.robosuite.tracking import calibrate, model_disagreement

Array = NDArray[np.float64]

MAX_DURATION_S = 30.0
"""A flight ends after this at the latest [s]."""
RANDOM_POLICY_DURATION_S = 5.0
"""How long a policy without a task flies [s]."""
OBSERVE_EVERY = 10
"""Periods between looks at the cubes."""
CALIBRATION_SEEDS = (1000, 1001)
"""Seeds of the flights that tracking is measured in."""
MAX_JOINT_SPEED = np.array([joint.velocity.value for joint in load_robot("panda").joints])
"""The data sheet's joint velocities [rad/s], which policies know."""
OTHER_CUBE, SET_DOWN_PHASES = "cubeB", ("lower", "open", "away")
"""A cube that nothing should push, until the first one is set down on it."""
MODES = ("unfiltered", "clipped", "filtered")
"""The wish as it is; each joint cut to the velocity limit that the filter is told of; through the filter."""


@dataclass
class EpisodeRecord:
    """What happened, period by period, and at the end."""

    q: list[Array] = field(default_factory=list)
    v: list[Array] = field(default_factory=list)
    u: list[Array] = field(default_factory=list)
    delta: list[float] = field(default_factory=list)
    status: list[int] = field(default_factory=list)
    h_min: float = float("inf")
    model_disagreement: float = 0.0
    pushed: float = 0.0
    time: float = 0.0
    unfinished_waypoint: str = ""

    def tracking_log(self) -> ExcitationLog:
        """What tracking is measured from."""
        return ExcitationLog(np.array(self.q), np.array(self.v), np.array(self.u))

    def metrics(self, robot_model: RobotModel) -> dict[str, Any]:
        """Times [s], shares of the data sheet's speed, the tracking error's leaky integral [rad], the filter's part."""
        log, tracking = self.tracking_log(), robot_model.tracking
        error = leaky_error(log, tracking.lag, tracking.rate, robot_model.period)
        found: dict[str, Any] = {
            "time": round(self.time, 3),
            "ended": self.unfinished_waypoint,
            "pushed": round(self.pushed, 5),
            "apart": self.model_disagreement,
            "asked": round(float(np.max(np.abs(log.u) / MAX_JOINT_SPEED)), 4),
            "speed": round(float(np.max(np.abs(log.v) / MAX_JOINT_SPEED)), 4),
            "strayed": round(float(np.abs(error).max()), 7),
            "steps": len(log.u),
        }
        if self.status:
            found |= {
                "delta": round(float(np.mean(self.delta)), 6),
                "h_min": round(self.h_min, 6),
                "status": np.bincount(self.status, minlength=len(FilterStatus)).tolist(),
            }
        return found


class ControlPath:
    """Turns wishes into what is sent."""

    def __init__(self, how: str, safety: SafetyFilter, watch: ObstacleTracker) -> None:
        self._mode, self._safety, self._obstacle_tracker = how, safety, watch
        self._velocity_limits = np.array([joint.velocity.value for joint in safety.robot_model.joints])
        self.record = EpisodeRecord()

    def control(self, state: State, tool: ToolState, policy: Policy, wish: Array) -> Array:
        """Joint velocities (n,) [rad/s] to be sent."""
        course, u = self.record, wish
        if self._mode == "clipped":
            u = np.clip(wish, -self._velocity_limits, self._velocity_limits)
        if self._mode == "filtered":
            if len(course.u) % OBSERVE_EVERY == 0:
                self._obstacle_tracker.update(state, tool, policy.waypoint)
            answer = self._safety(state.q, state.v, wish, state.time, state.opening)
            u = answer.u
            course.delta.append(answer.delta)
            course.status.append(int(answer.status))
            course.h_min = min(course.h_min, answer.h_min)
        course.q.append(state.q)
        course.v.append(state.v)
        course.u.append(u)
        return u


def calibrated_robot(suite: SuiteProcess) -> RobotModel:
    """The body that the filter is told of: the suite's period, its motors, and how its arm was seen to follow."""

    def flights(robot_model: RobotModel) -> list[list[ExcitationLog]]:
        return [
            [
                _run(
                    suite, robot_model, {"task": task, "policy": policy, "seed": seed, "how": "filtered"}
                ).tracking_log()
                for task in TASKS
                for policy in SPEED_PROFILES
            ]
            for seed in CALIBRATION_SEEDS
        ]

    return calibrate(suite, flights)


def run_episode(suite: SuiteProcess, robot_model: RobotModel, about: dict[str, Any]) -> dict[str, Any]:
    """One flight of `about` (task, policy, seed, how), from the suite's own start to the script's end."""
    course = _run(suite, robot_model, about)
    return {
        **about,
        **suite.limit_report(),
        **course.metrics(robot_model),
        "lag": robot_model.tracking.lag,
        "allowed_error": robot_model.tracking.position_error,
        "versions": suite.versions,
    }


def _run(suite: SuiteProcess, robot_model: RobotModel, about: dict[str, Any]) -> EpisodeRecord:
    opened = suite.open(about["task"], about["seed"])
    safety = SafetyFilter(robot_model, fixed_obstacles=static_obstacles(opened.things))
    apart, _ = model_disagreement(suite, safety, np.random.default_rng(about["seed"]))
    state = suite.parse_state(opened.state)
    policy = _make_policy(about, opened, state)
    pilot = ControlPath(about["how"], safety, ObstacleTracker(safety, opened.things))
    course, begin = pilot.record, state.cubes
    course.model_disagreement = apart
    while not policy.done and state.time < MAX_DURATION_S:
        tool = safety.tool(state.q)
        wish = policy.nominal(state.time, state.q, tool, state.cubes)
        state = suite.step(pilot.control(state, tool, policy, wish), policy.waypoint.closed)
        if policy.waypoint.name not in SET_DOWN_PHASES and OTHER_CUBE in begin:
            course.pushed = max(course.pushed, _planar_displacement(begin[OTHER_CUBE], state.cubes[OTHER_CUBE]))
    course.time, course.unfinished_waypoint = state.time, "" if policy.done else policy.waypoint.name
    return course


def _planar_displacement(before: Pose, after: Pose) -> float:
    """How far a thing has been pushed in the plane [m]."""
    return float(np.linalg.norm(np.array(after.position)[:2] - np.array(before.position)[:2]))


def _make_policy(about: dict[str, Any], opened: TaskSetup, state: State) -> Policy:
    if about["policy"] == "random":
        return BangBangPolicy(MAX_JOINT_SPEED, opened.cubes[0], about["seed"], RANDOM_POLICY_DURATION_S)
    points = TASKS[about["task"]](about["policy"] == "hasty")
    return WaypointPolicy(points, SPEED_PROFILES[about["policy"]], MAX_JOINT_SPEED, state.q, opened.period)
