"""A closed loop of one robot on a target: random scenes, permits, held objects, rows and bad input."""

from __future__ import annotations

from collections import Counter

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from dualbrain.core.geometry.shapes import Box, Capsule, Pose, Sphere
from dualbrain.robots.differential_drive import integrate_configuration
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Contact, NearSpeed, Obstacle
from dualbrain.safety.cbf.rows import ConstraintRow

Array = NDArray[np.float64]
SCENE_PERIOD, NEW_SCENE_PERIOD, NOMINAL_PERIOD = 33, 500, 120
"""Steps between two observations of a scene, two scenes, and two nominal controls."""
BAD_STATE, LATE_STATE, BAD_NOMINAL = 397, 431, 463
"""Periods [steps] of a joint state of NaN, of a state that is 1 s late, and of a nominal control of NaN."""
MAX_OBSTACLES = 40


class RandomMotion:
    """Inputs and motion of one robot; the same seed gives the same inputs on every target with the same bits."""

    def __init__(self, robot_model: RobotModel, rng: np.random.Generator) -> None:
        """Start at home at rest."""
        self._robot_model, self._rng = robot_model, rng
        self._v_max = np.array([joint.velocity.value for joint in robot_model.joints])
        self._home = np.array(robot_model.home)
        self._scene = list[Obstacle]()

    def run(self, safety: SafetyFilter, steps: int) -> Counter[str]:
        """Carry out `steps` steps from home; returns the number of results by status."""
        model, rng, statuses = self._robot_model, self._rng, Counter[str]()
        q, u, u_nom = self._home.copy(), np.zeros(model.n), np.zeros(model.n)
        safety.reset()
        for i in range(steps):
            now = model.period * i
            if i % NEW_SCENE_PERIOD == 0:
                q, u = self._home.copy(), np.zeros(model.n)
                self._begin_scene(safety)
            if i % SCENE_PERIOD == 0:
                self._observe(safety, now)
            if i % NOMINAL_PERIOD == 0:
                u_nom = rng.choice([-1.0, 1.0], model.n) * self._v_max
            given = np.full(len(q), np.nan) if i % BAD_STATE == 1 else q
            wished = np.full(model.n, np.nan) if i % BAD_NOMINAL == 1 else u_nom
            late = 1.0 if i % LATE_STATE == 1 else 0.0
            result = safety(given, u, wished, now + late, self._opening(i))
            statuses[result.status.name] += 1
            u = result.u.copy()
            q = integrate_configuration(q, u, model.period) if model.base == "differential" else q + model.period * u
        return statuses

    def _opening(self, i: int) -> float | None:
        gripper = self._robot_model.gripper
        return gripper.opening.value * (0.5 + 0.5 * np.sin(0.01 * i)) if gripper and i % 7 else None

    def _begin_scene(self, safety: SafetyFilter) -> None:
        """New obstacles, and by chance a permit, a held object and an additional row."""
        model, rng = self._robot_model, self._rng
        safety.reset()
        self._scene = [self._random_obstacle(k) for k in range(int(rng.integers(0, MAX_OBSTACLES)))]
        safety.detach()
        if model.gripper and rng.random() < 0.5:
            safety.attach([[0.0, 0.0, float(rng.uniform(0.02, 0.1)), 0.03]], 0.004)
        slow = ConstraintRow(name="slow", a=(1.0, *[0.0] * (model.n - 1)), b=-0.1)
        safety.constrain([slow] if rng.random() < 0.3 else [])

    def _observe(self, safety: SafetyFilter, now: float) -> None:
        """Pass the scene, with moving obstacles at their places at `now`, and permit one contact."""
        step = SCENE_PERIOD * self._robot_model.period
        self._scene = [_moved(obstacle, step) for obstacle in self._scene]
        safety.observe(self._scene, now)
        if self._scene:
            part = next(iter(dict.fromkeys(link.name for link in reversed(self._robot_model.links))))
            safety.permit([Contact(part, self._scene[0].name, 0.05)])

    def _random_obstacle(self, k: int) -> Obstacle:
        rng, moves = self._rng, bool(k % 3 == 1)
        half = [float(x) for x in rng.uniform(0.02, 0.12, 3)]
        shape = (Sphere(half[0]), Capsule(half[0], half[1]), Box((half[0], half[1], half[2])))[k % 3]
        w, *xyz = (turn := rng.normal(size=4)) / np.linalg.norm(turn)
        far = (0.8, 2.5) if self._robot_model.base == "differential" else (0.35, 0.9)
        reach, angle = rng.uniform(*far), rng.uniform(-np.pi, np.pi)
        place = (float(reach * np.cos(angle)), float(reach * np.sin(angle)), float(rng.uniform(0.0, 0.9)))
        velocity = tuple(float(x) for x in rng.uniform(-0.2, 0.2, 3)) if moves else (0.0, 0.0, 0.0)
        return Obstacle(
            name=f"o{k}",
            shape=shape,
            pose=Pose(place, (float(w), *(float(x) for x in xyz))),
            velocity=velocity,
            velocity_error=0.02 * moves,
            margin=0.005,
            static=not moves,
            near=NearSpeed(0.3) if k % 6 == 5 else None,
        )


def _moved(obstacle: Obstacle, seconds: float) -> Obstacle:
    if obstacle.static:
        return obstacle
    place = tuple(float(x + seconds * v) for x, v in zip(obstacle.pose.position, obstacle.velocity, strict=True))
    return replace(obstacle, pose=replace(obstacle.pose, position=place))
