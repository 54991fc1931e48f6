"""The chassis: what every skill can do with a differential base, each as a short story of nominal controls (v, ω)."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from itertools import pairwise
from math import atan2, cos, inf, pi, sqrt

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.skill_spec import SkillSpec
from dualbrain.errors import ConfigurationError
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.model import RobotModel
from dualbrain.skills.human_prediction import min_person_distance
from dualbrain.skills.mobile_base.path_planning import plan_path
from dualbrain.skills.progress_watchdog import ProgressWatchdog
from dualbrain.skills.skill import HeldObject, MotionModel, Nominal, Observation, SkillResult, SkillStatus
from dualbrain.skills.time_slicing import BackgroundComputation, steps_per_tick

Array = NDArray[np.float64]
SubRoutine = Generator[Nominal | None, None, SkillResult | None]

LOOKAHEAD_DISTANCE = 0.45
"""How far ahead on its path the base steers [m]."""
TURN_IN_PLACE_ANGLE = 0.7
"""A path that lies more than this off the heading is turned to before it is driven [rad]."""
STEERING_GAIN = 2.5
"""Turn rate asked for per error of heading [1/s]."""
POSITION_TOLERANCE, HEADING_TOLERANCE = 0.06, 0.02
"""A point is reached [m], a heading taken [rad] within these."""
BRAKE_FRACTION = 0.5
"""Share of the acceleration limits with which φ comes to rest."""
DRIVE_PROGRESS_TIMEOUT = 6.0
"""No progress for this long [s] ends a drive; people are waited for apart."""
PERSON_WAIT_TIMEOUT = 30.0
"""How long [s] a skill waits for a person before it says so and fails."""
NEW_WAIT_DISTANCE = 0.5
"""Having moved this far [m] since it began to wait, the base waits anew; less is only inching up to somebody."""
PASSING_CLEARANCE = 0.4
"""Going on must leave this much between the footprint and whoever passes [m], or the base lets them pass."""
YIELD_SPEED = 0.5
"""How fast the base gets out of a person's way [m/s], whatever speed it was asked to drive at."""
PREDICTION_HORIZON = 3.0
"""How far ahead people are believed to go on as they do, at least [s]."""
PASSING_DISTANCE = 2.2
"""The way [m] on which somebody is passed: until the base has driven it, they are believed to go on."""
REPLAN_PERIOD = 1.0
"""A new way is looked for this long [s] after the last, while driving on."""


class BaseController:
    """One base, as the skills move it. State: φ's memory and the current senses."""

    def __init__(self, robot_model: RobotModel, motion: MotionModel) -> None:
        """Bind to a body and to what the local layer lends; call `sense` before every step of a story."""
        self.robot_model = robot_model
        self.holding: HeldObject | None = None
        self.footprint_radius = max(float(np.hypot(*ball.centre[:2])) + ball.radius for ball in robot_model.spheres)
        """Of the circle round the footprint [m]."""
        self._motion = motion
        self._brake = BRAKE_FRACTION * np.array([joint.acceleration.value for joint in robot_model.joints[:2]])
        self._u_nom = self._u_nom_prev = np.zeros(robot_model.n)
        self._observation: Observation | None = None

    # --- senses -------------------------------------------------------------------------------------------------

    def observe(self, observation: Observation) -> None:
        """Take in this tick's senses."""
        self._observation = observation

    @property
    def observation(self) -> Observation:
        """This tick's senses."""
        if self._observation is None:
            raise ConfigurationError(
                "a chassis without senses", got=None, allowed="one call of `sense` before the first tick"
            )
        return self._observation

    @property
    def pose(self) -> tuple[Array, float]:
        """Position (2,) [m] and heading [rad]."""
        q = self.observation.state.q
        return q[:2].copy(), float(q[2])

    def with_keep_out_boxes(self, scene: Scene) -> Scene:
        """`scene` with what the site closes standing in it: what a way has to go round."""
        return msgspec.structs.replace(scene, objects=(*scene.objects, *self._motion.keep_out_boxes))

    def find_object(self, name: str) -> SceneObject:
        """The thing called `name` as perceived now."""
        return self.observation.scene.find(name)

    def begin(self, spec: SkillSpec, **others: str | None) -> None:
        """Start a skill: nothing may be touched by a base."""
        del spec, others

    # --- parts of a story ---------------------------------------------------------------------------------------

    def drive(self, goal: Array, speed: float, rate: float) -> SubRoutine:
        """Drive to `goal` (2,) [m] at up to `speed` [m/s] and `rate` [rad/s]; wait for people who cross."""
        here, _ = self.pose
        path = yield from plan_path(self.with_keep_out_boxes(self.observation.scene), here, goal, self.footprint_radius)
        if path is None:
            return SkillResult(SkillStatus.FAILED, "no way leads there")
        progress, looked = self._make_watchdog(path, speed), self.observation.now
        newer: BackgroundComputation[list[Array] | None] | None = None
        stood, since = here, -inf
        while True:
            here, heading = self.pose
            away = float(np.linalg.norm(goal - here))
            if away < POSITION_TOLERANCE:
                return (yield from self.come_to_rest("drive"))
            pace = self._passing_speed(path, here, speed)
            if pace == 0.0:
                if since == -inf or float(np.linalg.norm(here - stood)) > NEW_WAIT_DISTANCE:
                    stood, since = here, self.observation.now
                if why := (yield from self._wait_for_people(path, speed, since)):
                    return why
                progress = self._make_watchdog(path, speed)
            if newer is None and self.observation.now - looked > REPLAN_PERIOD:
                way = plan_path(self.with_keep_out_boxes(self.observation.scene), here, goal, self.footprint_radius)
                newer = BackgroundComputation(way, steps_per_tick(self.robot_model.period))
            if newer is not None and newer.advance():
                path, looked, newer = newer.result or path, self.observation.now, None
            if why := progress.update(
                self.observation.active_time, away + 0.05 * abs(_heading_error(heading, path, here))
            ):
                return SkillResult(SkillStatus.TAKEN_OVER, f"drive: {why}, {away * 100:.0f} cm from the goal")
            yield self._nominal(self._steer(path, here, heading, away, pace, rate), "drive")

    def turn(self, heading: float, rate: float) -> SubRoutine:
        """Turn on the spot to `heading` [rad] at up to `rate` [rad/s], the shorter way."""
        progress = ProgressWatchdog(
            self.observation.active_time, time_limit=10.0 + 8.0 / rate, timeout=DRIVE_PROGRESS_TIMEOUT
        )
        while True:
            error = wrap_angle(heading - self.pose[1])
            if abs(error) < HEADING_TOLERANCE and abs(float(self.observation.state.v[1])) < 0.05:
                return (yield from self.come_to_rest("turn"))
            if why := progress.update(self.observation.active_time, 0.2 * abs(error)):
                return SkillResult(SkillStatus.TAKEN_OVER, f"turn: {why}, {abs(error):.2f} rad from the heading")
            fast = min(rate, STEERING_GAIN * abs(error), sqrt(2.0 * float(self._brake[1]) * abs(error)))
            yield self._nominal(np.array([0.0, fast if error > 0.0 else -fast]), "turn")

    def come_to_rest(self, phase: str) -> SubRoutine:
        """Brake until nothing moves."""
        end = self.observation.now + 3.0
        while self.observation.now < end and float(np.max(np.abs(self.observation.state.v))) > 5e-3:
            yield self.rest(phase)
        return None

    # --- what the local layer calls -----------------------------------------------------------------------------

    def rest(self, phase: str) -> Nominal:
        """One tick of standing still."""
        return self._nominal(np.zeros(self.robot_model.n), phase)

    def detect_grasp(self, name: str) -> bool:
        """A base has no hand."""
        del name
        return False

    def reproject(self, u: Array) -> Array:
        """u_nom (n,) once more, because what φ knows changed since this tick's was made."""
        self._u_nom = self._u_nom_prev
        return self._project(u)

    # --- inside -------------------------------------------------------------------------------------------------

    def _steer(
        self, path: Sequence[Array], here: Array, heading: float, away: float, speed: float, rate: float
    ) -> Array:
        """Pure pursuit: toward the point `AHEAD` on the path; turn first when it lies aside."""
        error = _heading_error(heading, path, here)
        turn = float(np.clip(STEERING_GAIN * error, -rate, rate))
        if abs(error) > TURN_IN_PLACE_ANGLE:
            return np.array([0.0, turn])
        fast = min(speed, sqrt(2.0 * float(self._brake[0]) * away)) * max(0.0, cos(error)) ** 2
        return np.array([fast, turn])

    def _make_watchdog(self, path: Sequence[Array], speed: float) -> ProgressWatchdog:
        length = sum(float(np.linalg.norm(b - a)) for a, b in pairwise(path))
        return ProgressWatchdog(
            self.observation.active_time, time_limit=20.0 + 4.0 * length / speed, timeout=DRIVE_PROGRESS_TIMEOUT
        )

    def _passing_speed(self, path: Sequence[Array], here: Array, speed: float) -> float:
        """How fast to go on [m/s]: `speed` where that leaves everybody their berth, else 0 to let them pass.

        Who stopped in the middle of somebody's way would be run into: there the base goes on, and makes haste.
        """
        scene, now = self.observation.scene, self.observation.now
        if not any(thing.role == "person" for thing in scene.objects):
            return speed
        horizon, berth = max(PREDICTION_HORIZON, PASSING_DISTANCE / speed), self.footprint_radius + PASSING_CLEARANCE
        moving = float(self.observation.state.v[0])

        def going(pace: float) -> float:
            late = max(0.0, pace - moving) / float(self._brake[0])
            return min_person_distance(
                scene, lambda t: _point_along(path, here, pace * max(0.0, t - late)), horizon, now
            )

        if going(speed) > berth:
            return speed
        standing = min_person_distance(scene, lambda t: here, horizon, now)
        haste = max(speed, YIELD_SPEED)
        return 0.0 if standing > berth or standing >= going(haste) else haste

    def _wait_for_people(self, path: Sequence[Array], speed: float, since: float) -> SubRoutine:
        """Stand until going on is the better answer, as was done `since` [s]; the filter may still back away."""
        while self._passing_speed(path, self.pose[0], speed) == 0.0:
            if self.observation.now - since > PERSON_WAIT_TIMEOUT:
                return SkillResult(
                    SkillStatus.FAILED, f"drive: a person stayed in the way for {PERSON_WAIT_TIMEOUT:.0f} s"
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
    """Angle from the heading to the point `AHEAD` on the path [rad]."""
    dx, dy = (_point_along(path, here, LOOKAHEAD_DISTANCE) - here).tolist()
    return wrap_angle(atan2(dy, dx) - heading)


def _point_along(path: Sequence[Array], here: Array, distance: float) -> Array:
    """The point (2,) that lies `reach` [m] beyond the path's point nearest to `here`."""
    best, at, share = np.inf, 0, 0.0
    for k, (a, b) in enumerate(pairwise(path)):
        line = b - a
        along = float(np.clip((here - a) @ line / (line @ line + 1e-12), 0.0, 1.0))
        away = float(np.linalg.norm(here - a - along * line))
        if away < best - 1e-9:
            best, at, share = away, k, along
    point, left = path[at] + share * (path[at + 1] - path[at]), distance
    for b in path[at + 1 :]:
        length = float(np.linalg.norm(b - point))
        if length >= left:
            return point + (b - point) * (left / max(length, 1e-9))
        point, left = b, left - length
    return path[-1]
