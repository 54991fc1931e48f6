"""Base controller: sub-routines from which the skills of a differential-drive base are composed (v, ω)."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from itertools import pairwise
from math import atan2, cos, inf, pi, sqrt

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.skill_spec import SkillSpec
from dualbrain.errors import ConfigurationError
from dualbrain.records import FailureCause, Scene, SceneObject
from dualbrain.robots.model import RobotModel
from dualbrain.skills.human_prediction import min_person_distance
from dualbrain.skills.mobile_base.path_planning import plan_path
from dualbrain.skills.progress_watchdog import ProgressWatchdog
from dualbrain.skills.skill import HeldObject, MotionModel, Nominal, Observation, SkillResult, SkillStatus
from dualbrain.skills.time_slicing import BackgroundComputation, steps_per_tick

Array = NDArray[np.float64]
SubRoutine = Generator[Nominal | None, None, SkillResult | None]

LOOKAHEAD_DISTANCE = 0.45
"""Distance of the steering point ahead on the path [m]."""
TURN_IN_PLACE_ANGLE = 0.7
"""Heading error above which the base turns in place before it drives [rad]."""
STEERING_GAIN = 2.5
"""Turn rate per heading error [1/s]."""
POSITION_TOLERANCE, HEADING_TOLERANCE = 0.06, 0.02
"""Tolerances of position [m] and heading [rad] at the goal."""
BRAKE_FRACTION = 0.5
"""Fraction of the acceleration limits that φ uses to brake."""
DRIVE_PROGRESS_TIMEOUT = 6.0
"""Time without progress [s] after which a drive ends; waiting for people does not count."""
PERSON_WAIT_TIMEOUT = 30.0
"""Time [s] for which a skill waits for a person before it fails."""
NEW_WAIT_DISTANCE = 0.5
"""Distance [m] that the base must move after a wait for the next wait to count as a new one."""
PASSING_CLEARANCE = 0.4
"""Least distance between the footprint and a passing person [m] at which the base drives on; else it waits."""
YIELD_SPEED = 0.5
"""Speed at which the base leaves the path of a person [m/s], above the speed parameter if necessary.

It is less if the limit of the object in the hand of a mobile manipulator is.
"""
PREDICTION_HORIZON = 3.0
"""Shortest horizon of the prediction of people [s]."""
PASSING_DISTANCE = 2.2
"""Distance [m] on which the base passes a person: the prediction covers the time until the base has driven it."""
DETOUR_LENGTH = 0.2
"""Additional length of a new path [m] with which the measurement of progress starts again."""
REPLAN_PERIOD = 1.0
"""Time [s] between the start of two path searches while driving."""


class BaseController:
    """Controller of one base. State: the memory of φ and the current observation."""

    def __init__(self, robot_model: RobotModel, motion: MotionModel) -> None:
        """Use `motion` for the projection; call `observe` before every step of a routine."""
        self.robot_model = robot_model
        self.holding: HeldObject | None = None
        """The object in the hand of a mobile manipulator."""
        self.footprint_radius = max(
            float(np.hypot(*sphere.centre[:2])) + sphere.radius for sphere in robot_model.spheres
        )
        """Radius of the circle around the footprint [m]."""
        self._motion = motion
        self._brake = BRAKE_FRACTION * np.array([joint.acceleration.value for joint in robot_model.joints[:2]])
        self._u_nom = self._u_nom_prev = np.zeros(robot_model.n)
        self._observation: Observation | None = None

    # --- observation --------------------------------------------------------------------------------------------

    def observe(self, observation: Observation) -> None:
        """Set the observation of this tick."""
        self._observation = observation

    @property
    def observation(self) -> Observation:
        """The observation of this tick; raises `ConfigurationError` before the first call of `observe`."""
        if self._observation is None:
            raise ConfigurationError.stating("BaseController.observe() must be called before the first tick.")
        return self._observation

    @property
    def pose(self) -> tuple[Array, float]:
        """Position (2,) [m] and heading [rad]."""
        q = self.observation.state.q
        return q[:2].copy(), float(q[2])

    def with_keep_out_boxes(self, scene: Scene) -> Scene:
        """`scene` with the boxes that the site keeps closed, as obstacles for path planning."""
        return msgspec.structs.replace(scene, objects=(*scene.objects, *self._motion.keep_out_boxes))

    def find_object(self, name: str) -> SceneObject:
        """The object `name` as perceived in this tick; raises `UnknownNameError`."""
        return self.observation.scene.find(name)

    def begin(self, spec: SkillSpec, **others: str | None) -> None:
        """Start a skill; a base has no permitted contacts."""
        del spec, others

    # --- sub-routines -------------------------------------------------------------------------------------------

    def drive(self, goal: Array, speed: float, rate: float) -> SubRoutine:
        """Drive to `goal` (2,) [m] at up to `speed` [m/s] and `rate` [rad/s]; wait for people who cross the path."""
        here, _ = self.pose
        path = yield from plan_path(self.with_keep_out_boxes(self.observation.scene), here, goal, self.footprint_radius)
        if path is None:
            return SkillResult(SkillStatus.FAILED, "no way leads there", FailureCause.OUT_OF_REACH)
        progress, planned_at = self._make_watchdog(path, speed), self.observation.now
        replanning: BackgroundComputation[list[Array] | None] | None = None
        wait_position, wait_start = here, -inf
        while True:
            here, heading = self.pose
            away = float(np.linalg.norm(goal - here))
            if away < POSITION_TOLERANCE:
                return (yield from self.come_to_rest("drive"))
            pace = self._passing_speed(path, here, speed)
            if pace == 0.0:
                if wait_start == -inf or float(np.linalg.norm(here - wait_position)) > NEW_WAIT_DISTANCE:
                    wait_position, wait_start = here, self.observation.active_time
                if why := (yield from self._wait_for_people(path, speed, wait_start)):
                    return why
                progress = self._make_watchdog(path, speed)
            if replanning is None and self.observation.now - planned_at > REPLAN_PERIOD:
                search = plan_path(self.with_keep_out_boxes(self.observation.scene), here, goal, self.footprint_radius)
                replanning = BackgroundComputation(search, steps_per_tick(self.robot_model.period))
            if replanning is not None and replanning.advance():
                before, path = path, replanning.result or path
                planned_at, replanning = self.observation.now, None
                if _length_left(path, here) > _length_left(before, here) + DETOUR_LENGTH:
                    progress = self._make_watchdog(path, speed)
            left = _length_left(path, here) + 0.05 * abs(_heading_error(heading, path, here))
            if why := progress.update(self.observation.active_time, left):
                return SkillResult(
                    SkillStatus.TAKEN_OVER, f"drive: {why}, {away * 100:.0f} cm from the goal", FailureCause.NO_PROGRESS
                )
            yield self._nominal(self._steer(path, here, heading, away, pace, rate), "drive")

    def turn(self, heading: float, rate: float) -> SubRoutine:
        """Turn in place to `heading` [rad] at up to `rate` [rad/s], in the shorter direction."""
        progress = ProgressWatchdog(
            self.observation.active_time, time_limit=10.0 + 8.0 / rate, timeout=DRIVE_PROGRESS_TIMEOUT
        )
        while True:
            error = wrap_angle(heading - self.pose[1])
            if abs(error) < HEADING_TOLERANCE and abs(float(self.observation.state.v[1])) < 0.05:
                return (yield from self.come_to_rest("turn"))
            if why := progress.update(self.observation.active_time, 0.2 * abs(error)):
                return SkillResult(
                    SkillStatus.TAKEN_OVER,
                    f"turn: {why}, {abs(error):.2f} rad from the heading",
                    FailureCause.NO_PROGRESS,
                )
            fast = min(rate, STEERING_GAIN * abs(error), sqrt(2.0 * float(self._brake[1]) * abs(error)))
            yield self._nominal(np.array([0.0, fast if error > 0.0 else -fast]), "turn")

    def come_to_rest(self, phase: str) -> SubRoutine:
        """Brake until the base is at rest."""
        end = self.observation.active_time + 3.0
        while self.observation.active_time < end and float(np.max(np.abs(self.observation.state.v))) > 5e-3:
            yield self.rest(phase)
        return None

    # --- interface to the control loop --------------------------------------------------------------------------

    def rest(self, phase: str) -> Nominal:
        """One tick without motion."""
        return self._nominal(np.zeros(self.robot_model.n), phase)

    def detect_grasp(self, name: str) -> bool:
        """False, because a base has no hand."""
        del name
        return False

    def resume_grasp(self, name: str, opening: float, force: float) -> bool:
        """False, because a base has no hand."""
        del name, opening, force
        return False

    def take_load_event(self) -> None:
        """None, because a base has no load."""
        return

    def check_holding(self) -> None:
        """Nothing, because a base has no hand."""

    def reproject(self, u: Array) -> Array:
        """u_nom (n,) projected again, because the rows known to φ changed within this tick."""
        self._u_nom = self._u_nom_prev
        return self._project(u)

    # --- internals ----------------------------------------------------------------------------------------------

    def _steer(
        self, path: Sequence[Array], here: Array, heading: float, away: float, speed: float, rate: float
    ) -> Array:
        """Pure pursuit of the point `LOOKAHEAD_DISTANCE` ahead on the path; turns in place for large heading errors."""
        error = _heading_error(heading, path, here)
        turn = float(np.clip(STEERING_GAIN * error, -rate, rate))
        if abs(error) > TURN_IN_PLACE_ANGLE:
            return np.array([0.0, turn])
        fast = min(speed, sqrt(2.0 * float(self._brake[0]) * away)) * max(0.0, cos(error)) ** 2
        return np.array([fast, turn])

    def _make_watchdog(self, path: Sequence[Array], speed: float) -> ProgressWatchdog:
        length = _length_left(path, self.pose[0])
        return ProgressWatchdog(
            self.observation.active_time, time_limit=20.0 + 4.0 * length / speed, timeout=DRIVE_PROGRESS_TIMEOUT
        )

    def _passing_speed(self, path: Sequence[Array], here: Array, speed: float) -> float:
        """Speed at which to continue [m/s]: `speed` if all people keep their distance, else 0 to let them pass.

        If standing still would block the path of a person, the base drives on at `YIELD_SPEED` or faster,
        within the limit of the object in the hand.
        """
        scene, now = self.observation.scene, self.observation.now
        if not any(obj.role == "person" for obj in scene.objects):
            return speed
        horizon = max(PREDICTION_HORIZON, PASSING_DISTANCE / speed)
        min_distance = self.footprint_radius + PASSING_CLEARANCE
        current = float(self.observation.state.v[0])

        def distance_at(pace: float) -> float:
            delay = max(0.0, pace - current) / float(self._brake[0])
            return min_person_distance(
                scene, lambda t: _point_along(path, here, pace * max(0.0, t - delay)), horizon, now
            )

        if distance_at(speed) > min_distance:
            return speed
        standing = min_person_distance(scene, lambda t: here, horizon, now)
        most = self.holding.speed_limit(scene) if self.holding else inf
        faster = max(speed, min(YIELD_SPEED, most))
        return 0.0 if standing > min_distance or standing >= distance_at(faster) else faster

    def _wait_for_people(self, path: Sequence[Array], speed: float, since: float) -> SubRoutine:
        """Rest until driving on is safe; the wait began at the active time `since` [s].

        The filter may still move the base away.
        """
        while self._passing_speed(path, self.pose[0], speed) == 0.0:
            if self.observation.active_time - since > PERSON_WAIT_TIMEOUT:
                return SkillResult(
                    SkillStatus.FAILED,
                    f"drive: a person stayed in the way for {PERSON_WAIT_TIMEOUT:.0f} s",
                    FailureCause.PERSON,
                )
            yield self.rest("wait")
        return None

    def _nominal(self, u_desired: Array, phase: str) -> Nominal:
        self._u_nom_prev = self._u_nom
        return Nominal(u=self._project(u_desired), opening=0.0, force=0.0, phase=phase)

    def _project(self, u_desired: Array) -> Array:
        self._u_nom = self._motion.project(self.observation.state, u_desired, self._u_nom_prev, self.observation.now)
        return self._u_nom


def wrap_angle(angle: float) -> float:
    """The same angle in (−π, π] [rad]."""
    return -((-angle + pi) % (2.0 * pi) - pi)


def _heading_error(heading: float, path: Sequence[Array], here: Array) -> float:
    """Angle from the heading to the point `LOOKAHEAD_DISTANCE` ahead on the path [rad]."""
    dx, dy = (_point_along(path, here, LOOKAHEAD_DISTANCE) - here).tolist()
    return wrap_angle(atan2(dy, dx) - heading)


def _nearest(path: Sequence[Array], here: Array) -> tuple[int, Array]:
    """The segment of the path nearest to `here`, and the point (2,) on it."""
    best, at, point = np.inf, 0, path[0]
    for k, (a, b) in enumerate(pairwise(path)):
        line = b - a
        along = float(np.clip((here - a) @ line / (line @ line + 1e-12), 0.0, 1.0))
        away = float(np.linalg.norm(here - a - along * line))
        if away < best - 1e-9:
            best, at, point = away, k, a + along * line
    return at, point


def _length_left(path: Sequence[Array], here: Array) -> float:
    """The length [m] of the path from the point nearest to `here`, and the distance to that point."""
    at, point = _nearest(path, here)
    rest = (point, *path[at + 1 :])
    return float(np.linalg.norm(here - point)) + sum(float(np.linalg.norm(b - a)) for a, b in pairwise(rest))


def _point_along(path: Sequence[Array], here: Array, distance: float) -> Array:
    """The point (2,) that is `distance` [m] beyond the point of the path nearest to `here`."""
    (at, point), left = _nearest(path, here), distance
    for b in path[at + 1 :]:
        length = float(np.linalg.norm(b - point))
        if length >= left:
            return point + (b - point) * (left / max(length, 1e-9))
        point, left = b, left - length
    return path[-1]
