"""One episode: a policy's controls go to the suite directly or through the filter; the result is a row."""

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
"""Time limit of an episode [s]."""
RANDOM_POLICY_DURATION_S = 5.0
"""Duration of a policy without a task [s]."""
OBSERVE_EVERY = 10
"""Periods between two observations of the cubes."""
CALIBRATION_SEEDS = (1000, 1001)
"""Seeds of the episodes in which tracking is measured."""
MAX_JOINT_SPEED = np.array([joint.velocity.value for joint in load_robot("panda").joints])
"""The data sheet's joint velocities [rad/s], which policies know."""
OTHER_CUBE, SET_DOWN_PHASES = "cubeB", ("lower", "open", "away")
"""The cube that nothing may push until the first one is set down on it, in these phases."""
MODES = ("unfiltered", "clipped", "filtered")
"""The policy's control directly; each joint clipped to the filter's velocity limit; through the filter."""


@dataclass(kw_only=True)
class EpisodeRecord:
    """The recorded periods of an episode, and its end."""

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
        """The log from which the tracking model is identified."""
        return ExcitationLog(np.array(self.q), np.array(self.v), np.array(self.u))

    def metrics(self, robot_model: RobotModel) -> dict[str, Any]:
        """The fields of a row: times [s], shares of the data sheet's speed, tracking error [rad], filter statistics."""
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
    """The path from a policy's nominal control to the control that is sent, in one of `MODES`."""

    def __init__(self, mode: str, safety: SafetyFilter, tracker: ObstacleTracker) -> None:
        self._mode, self._safety, self._obstacle_tracker = mode, safety, tracker
        self._velocity_limits = np.array([joint.velocity.value for joint in safety.robot_model.joints])
        self.record = EpisodeRecord()

    def control(self, state: State, tool: ToolState, policy: Policy, u_nom: Array) -> Array:
        """Joint velocities (n,) [rad/s] to be sent for the nominal ones `u_nom` (n,)."""
        record, u = self.record, u_nom
        if self._mode == "clipped":
            u = np.clip(u_nom, -self._velocity_limits, self._velocity_limits)
        if self._mode == "filtered":
            if len(record.u) % OBSERVE_EVERY == 0:
                self._obstacle_tracker.update(state, tool, policy.waypoint)
            result = self._safety(state.q, state.v, u_nom, state.time, state.opening)
            u = result.u
            record.delta.append(result.delta)
            record.status.append(int(result.status))
            record.h_min = min(record.h_min, result.h_min)
        record.q.append(state.q)
        record.v.append(state.v)
        record.u.append(u)
        return u


def calibrated_robot(suite: SuiteProcess) -> RobotModel:
    """The robot model of the filter: with the suite's period, motor limits, and the identified tracking model."""

    def run_episodes(robot_model: RobotModel) -> list[list[ExcitationLog]]:
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

    return calibrate(suite, run_episodes)


def run_episode(suite: SuiteProcess, robot_model: RobotModel, parameters: dict[str, Any]) -> dict[str, Any]:
    """The row of one episode with its `parameters`, from the suite's own start to the end of the policy."""
    record = _run(suite, robot_model, parameters)
    return {
        **parameters,
        **suite.limit_report(),
        **record.metrics(robot_model),
        "lag": robot_model.tracking.lag,
        "allowed_error": max(robot_model.tracking.position_errors(robot_model.n)),
        "versions": suite.versions,
    }


def _run(suite: SuiteProcess, robot_model: RobotModel, parameters: dict[str, Any]) -> EpisodeRecord:
    opened = suite.open(parameters["task"], parameters["seed"])
    safety = SafetyFilter(robot_model, obstacles=static_obstacles(opened.things))
    apart, _ = model_disagreement(suite, safety, np.random.default_rng(parameters["seed"]))
    state = suite.parse_state(opened.state)
    policy = _make_policy(parameters, opened, state)
    path = ControlPath(parameters["how"], safety, ObstacleTracker(safety, opened.things))
    record, start = path.record, state.cubes
    record.model_disagreement = apart
    while not policy.done and state.time < MAX_DURATION_S:
        tool = safety.tool(state.q)
        u_nom = policy.nominal(state.time, state.q, tool, state.cubes)
        state = suite.step(path.control(state, tool, policy, u_nom), policy.waypoint.closed)
        if policy.waypoint.name not in SET_DOWN_PHASES and OTHER_CUBE in start:
            record.pushed = max(record.pushed, _planar_displacement(start[OTHER_CUBE], state.cubes[OTHER_CUBE]))
    record.time, record.unfinished_waypoint = state.time, "" if policy.done else policy.waypoint.name
    return record


def _planar_displacement(before: Pose, after: Pose) -> float:
    """Horizontal displacement [m]."""
    return float(np.linalg.norm(np.array(after.position)[:2] - np.array(before.position)[:2]))


def _make_policy(parameters: dict[str, Any], opened: TaskSetup, state: State) -> Policy:
    if parameters["policy"] == "random":
        return BangBangPolicy(MAX_JOINT_SPEED, opened.cubes[0], parameters["seed"], RANDOM_POLICY_DURATION_S)
    points = TASKS[parameters["task"]](parameters["policy"] == "hasty")
    return WaypointPolicy(points, SPEED_PROFILES[parameters["policy"]], MAX_JOINT_SPEED, state.q, opened.period)
