"""The chassis: what every skill can do with a differential base, each as a short story of nominal controls (v, ω)."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from itertools import pairwise
from math import atan2, cos, inf, pi, sqrt

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.skill_spec import SkillSpec
from dualbrain.errors import InvalidSetup
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.model import Body
from dualbrain.skills.human_prediction import room_left
from dualbrain.skills.mobile_base.path_planning import floor_path
from dualbrain.skills.progress_watchdog import Progress
from dualbrain.skills.skill import Ending, Holding, Motion, Nominal, Senses, Status
from dualbrain.skills.time_slicing import Aside, glances

Array = NDArray[np.float64]
Part = Generator[Nominal | None, None, Ending | None]

AHEAD = 0.45
"""How far ahead on its path the base steers [m]."""
TURN_FIRST = 0.7
"""A path that lies more than this off the heading is turned to before it is driven [rad]."""
STEER = 2.5
"""Turn rate asked for per error of heading [1/s]."""
ARRIVED, ALIGNED = 0.06, 0.02
"""A point is reached [m], a heading taken [rad] within these."""
BRAKE_SHARE = 0.5
"""Share of the acceleration limits with which φ comes to rest."""
PATIENCE = 6.0
"""No progress for this long [s] ends a drive; people are waited for apart."""
PERSON_PATIENCE = 30.0
"""How long [s] a skill waits for a person before it says so and fails."""
ELSEWHERE = 0.5
"""Having moved this far [m] since it began to wait, the base waits anew; less is only inching up to somebody."""
BERTH = 0.4
"""Going on must leave this much between the footprint and whoever passes [m], or the base lets them pass."""
YIELD_SPEED = 0.5
"""How fast the base gets out of a person's way [m/s], whatever speed it was asked to drive at."""
LOOK_AHEAD = 3.0
"""How far ahead people are believed to go on as they do, at least [s]."""
PASSING = 2.2
"""The way [m] on which somebody is passed: until the base has driven it, they are believed to go on."""
AGAIN = 1.0
"""A new way is looked for this long [s] after the last, while driving on."""


class Chassis:
    """One base, as the skills move it. State: φ's memory and the current senses."""

    def __init__(self, body: Body, motion: Motion) -> None:
        """Bind to a body and to what the local layer lends; call `sense` before every step of a story."""
        self.body = body
        self.holding: Holding | None = None
        self.radius = max(float(np.hypot(*ball.centre[:2])) + ball.radius for ball in body.spheres)
        """Of the circle round the footprint [m]."""
        self._motion = motion
        self._brake = BRAKE_SHARE * np.array([joint.acceleration.value for joint in body.joints[:2]])
        self._u_nom = self._before = np.zeros(body.n)
        self._senses: Senses | None = None

    # --- senses -------------------------------------------------------------------------------------------------

    def sense(self, senses: Senses) -> None:
        """Take in this tick's senses."""
        self._senses = senses

    @property
    def senses(self) -> Senses:
        """This tick's senses."""
        if self._senses is None:
            raise InvalidSetup(
                "a chassis without senses", got=None, allowed="one call of `sense` before the first tick"
            )
        return self._senses

    @property
    def pose(self) -> tuple[Array, float]:
        """Position (2,) [m] and heading [rad]."""
        q = self.senses.state.q
        return q[:2].copy(), float(q[2])

    def ground(self, scene: Scene) -> Scene:
        """`scene` with what the site closes standing in it: what a way has to go round."""
        return msgspec.structs.replace(scene, objects=(*scene.objects, *self._motion.closed))

    def see(self, name: str) -> SceneObject:
        """The thing called `name` as perceived now."""
        return self.senses.scene.find(name)

    def begin(self, spec: SkillSpec, **others: str | None) -> None:
        """Start a skill: nothing may be touched by a base."""
        del spec, others

    # --- parts of a story ---------------------------------------------------------------------------------------

    def drive(self, goal: Array, speed: float, rate: float) -> Part:
        """Drive to `goal` (2,) [m] at up to `speed` [m/s] and `rate` [rad/s]; wait for people who cross."""
        here, _ = self.pose
        path = yield from floor_path(self.ground(self.senses.scene), here, goal, self.radius)
        if path is None:
            return Ending(Status.FAILED, "no way leads there")
        progress, looked = self._progress(path, speed), self.senses.now
        newer: Aside[list[Array] | None] | None = None
        stood, since = here, -inf
        while True:
            here, heading = self.pose
            away = float(np.linalg.norm(goal - here))
            if away < ARRIVED:
                return (yield from self.come_to_rest("drive"))
            pace = self._pace(path, here, speed)
            if pace == 0.0:
                if since == -inf or float(np.linalg.norm(here - stood)) > ELSEWHERE:
                    stood, since = here, self.senses.now
                if why := (yield from self._wait(path, speed, since)):
                    return why
                progress = self._progress(path, speed)
            if newer is None and self.senses.now - looked > AGAIN:
                way = floor_path(self.ground(self.senses.scene), here, goal, self.radius)
                newer = Aside(way, glances(self.body.period))
            if newer is not None and newer.go_on():
                path, looked, newer = newer.answer or path, self.senses.now, None
            if why := progress.stuck(self.senses.patience, away + 0.05 * abs(_turn(heading, path, here))):
                return Ending(Status.TAKEN_OVER, f"drive: {why}, {away * 100:.0f} cm from the goal")
            yield self._nominal(self._steer(path, here, heading, away, pace, rate), "drive")

    def turn(self, heading: float, rate: float) -> Part:
        """Turn on the spot to `heading` [rad] at up to `rate` [rad/s], the shorter way."""
        progress = Progress(self.senses.patience, limit=10.0 + 8.0 / rate, patience=PATIENCE)
        while True:
            error = wrapped(heading - self.pose[1])
            if abs(error) < ALIGNED and abs(float(self.senses.state.v[1])) < 0.05:
                return (yield from self.come_to_rest("turn"))
            if why := progress.stuck(self.senses.patience, 0.2 * abs(error)):
                return Ending(Status.TAKEN_OVER, f"turn: {why}, {abs(error):.2f} rad from the heading")
            fast = min(rate, STEER * abs(error), sqrt(2.0 * float(self._brake[1]) * abs(error)))
            yield self._nominal(np.array([0.0, fast if error > 0.0 else -fast]), "turn")

    def come_to_rest(self, phase: str) -> Part:
        """Brake until nothing moves."""
        end = self.senses.now + 3.0
        while self.senses.now < end and float(np.max(np.abs(self.senses.state.v))) > 5e-3:
            yield self.rest(phase)
        return None

    # --- what the local layer calls -----------------------------------------------------------------------------

    def rest(self, phase: str) -> Nominal:
        """One tick of standing still."""
        return self._nominal(np.zeros(self.body.n), phase)

    def catch(self, name: str) -> bool:
        """A base has no hand."""
        del name
        return False

    def reconsider(self, u: Array) -> Array:
        """u_nom (n,) once more, because what φ knows changed since this tick's was made."""
        self._u_nom = self._before
        return self._project(u)

    # --- inside -------------------------------------------------------------------------------------------------

    def _steer(
        self, path: Sequence[Array], here: Array, heading: float, away: float, speed: float, rate: float
    ) -> Array:
        """Pure pursuit: toward the point `AHEAD` on the path; turn first when it lies aside."""
        error = _turn(heading, path, here)
        turn = float(np.clip(STEER * error, -rate, rate))
        if abs(error) > TURN_FIRST:
            return np.array([0.0, turn])
        fast = min(speed, sqrt(2.0 * float(self._brake[0]) * away)) * max(0.0, cos(error)) ** 2
        return np.array([fast, turn])

    def _progress(self, path: Sequence[Array], speed: float) -> Progress:
        length = sum(float(np.linalg.norm(b - a)) for a, b in pairwise(path))
        return Progress(self.senses.patience, limit=20.0 + 4.0 * length / speed, patience=PATIENCE)

    def _pace(self, path: Sequence[Array], here: Array, speed: float) -> float:
        """How fast to go on [m/s]: `speed` where that leaves everybody their berth, else 0 to let them pass.

        Who stopped in the middle of somebody's way would be run into: there the base goes on, and makes haste.
        """
        scene, now = self.senses.scene, self.senses.now
        if not any(thing.role == "person" for thing in scene.objects):
            return speed
        horizon, berth = max(LOOK_AHEAD, PASSING / speed), self.radius + BERTH
        moving = float(self.senses.state.v[0])

        def going(pace: float) -> float:
            late = max(0.0, pace - moving) / float(self._brake[0])
            return room_left(scene, lambda t: _along(path, here, pace * max(0.0, t - late)), horizon, now)

        if going(speed) > berth:
            return speed
        standing = room_left(scene, lambda t: here, horizon, now)
        haste = max(speed, YIELD_SPEED)
        return 0.0 if standing > berth or standing >= going(haste) else haste

    def _wait(self, path: Sequence[Array], speed: float, since: float) -> Part:
        """Stand until going on is the better answer, as was done `since` [s]; the filter may still back away."""
        while self._pace(path, self.pose[0], speed) == 0.0:
            if self.senses.now - since > PERSON_PATIENCE:
                return Ending(Status.FAILED, f"drive: a person stayed in the way for {PERSON_PATIENCE:.0f} s")
            yield self.rest("wait")
        return None

    def _nominal(self, wish: Array, phase: str) -> Nominal:
        self._before = self._u_nom
        return Nominal(self._project(wish), 0.0, 0.0, phase)

    def _project(self, wish: Array) -> Array:
        self._u_nom = self._motion.project(self.senses.state, wish, self._before, self.senses.now)
        return self._u_nom


def wrapped(angle: float) -> float:
    """The same angle in (−π, π] [rad]."""
    return -((-angle + pi) % (2.0 * pi) - pi)


def _turn(heading: float, path: Sequence[Array], here: Array) -> float:
    """Angle from the heading to the point `AHEAD` on the path [rad]."""
    dx, dy = (_along(path, here, AHEAD) - here).tolist()
    return wrapped(atan2(dy, dx) - heading)


def _along(path: Sequence[Array], here: Array, reach: float) -> Array:
    """The point (2,) that lies `reach` [m] beyond the path's point nearest to `here`."""
    best, at, share = np.inf, 0, 0.0
    for k, (a, b) in enumerate(pairwise(path)):
        line = b - a
        along = float(np.clip((here - a) @ line / (line @ line + 1e-12), 0.0, 1.0))
        away = float(np.linalg.norm(here - a - along * line))
        if away < best - 1e-9:
            best, at, share = away, k, along
    point, left = path[at] + share * (path[at + 1] - path[at]), reach
    for b in path[at + 1 :]:
        length = float(np.linalg.norm(b - point))
        if length >= left:
            return point + (b - point) * (left / max(length, 1e-9))
        point, left = b, left - length
    return path[-1]
