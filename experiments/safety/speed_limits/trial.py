"""Loops of the experiment `speed_limits`: a random scene, a start posture, and a filter that an adversary drives."""

from __future__ import annotations

import zlib
from dataclasses import dataclass
from functools import cache

import numpy as np

from dualbrain.core.geometry.shapes import Capsule, Pose
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.compiled._kernel import ReferenceDistance
from dualbrain.safety.cbf.filter import Rank, SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.stop_cause import Reason
from experiments.engine.experiment import Row
from experiments.safety import random_scenes
from experiments.safety.adversary.classes import FAST_OBSTACLE, UNDISTURBED
from experiments.safety.reference_judge import build_judge, obstacle_rows, true_h
from experiments.safety.speed_limits.classes import HELD, SpeedClass
from experiments.safety.speed_limits.point_speeds import Array

PERSON = Capsule(0.1, 0.6)
STATUSES = ("safe", "modified", "relaxed", "stopped", "fault")
EXACT_ATTACK = {
    **UNDISTURBED,
    **{name: FAST_OBSTACLE[name] for name in ("evadable", "mover_speed", "mover_acceleration")},
}


@dataclass(frozen=True, slots=True, kw_only=True)
class Trial:
    """A scene with a start posture `start` (n,) and a filter that has not seen it yet."""

    kind: SpeedClass
    seed: int
    start: Array
    obstacles: list[Obstacle]
    """The obstacles as the filter knows them."""
    person: Obstacle | None

    def run(self, steps: int) -> tuple[Array, Array, Row]:
        """Postures before each step (steps, n), controls (steps, n), and counts by status."""
        return self._loop(self._filter(), steps)

    def reports_overspeed(self, step: int) -> bool:
        """Whether the filter reports in `step` that it found no control that keeps the speed limits.

        The loop is repeated up to this step. The report follows from the state alone, not from the nominal control.
        """
        safety = self._filter()
        q, u, _ = self._loop(safety, step) if step else (self.start[None], np.zeros((1, len(self.start))), {})
        posture = q[-1] + safety.robot_model.period * u[-1]
        return bool(safety(posture, u[-1], u[-1], 0.0, 0.0).flags & Reason.OVERSPEED)

    def _filter(self) -> SafetyFilter:
        safety = SafetyFilter(load_arm(self.kind.robot)[0], self.kind.filter_config())
        if self.kind.holds_object and self.kind.knows_object:
            safety.attach(np.array(HELD), 0.0)
        safety.observe(self.obstacles, 0.0)
        safety.reset()
        return safety

    def _loop(self, safety: SafetyFilter, steps: int) -> tuple[Array, Array, Row]:
        if self.kind.evades:
            return _attacked_loop(safety, load_arm(self.kind.robot)[1], self.obstacles, self.start, self.seed, steps)
        return _driven_loop(safety, self.start, self.seed, steps)


def make_trial(kind: SpeedClass, seed: int) -> Trial:
    """A random scene and start posture, the same for a class and its negative control."""
    robot_model, judge = load_arm(kind.robot)
    rng = np.random.default_rng([seed, zlib.crc32((kind.compared_with or kind.name).encode())])
    start = random_scenes.random_posture(robot_model, judge, rng)
    obstacles = random_scenes.random_obstacles(judge, start, rng, int(rng.integers(4, 9)))
    person = _random_person(judge, start, rng) if kind.near else None
    if kind.evades:
        obstacles.append(random_scenes.random_moving_obstacle(judge, start, rng))
    if person:
        obstacles.append(_with_limit(person, kind))
    return Trial(kind=kind, seed=seed, start=start, obstacles=obstacles, person=person)


@cache
def load_arm(robot: str) -> tuple[RobotModel, ReferenceDistance]:
    """The robot with all spheres, fingers closed, and the reference distances for it."""
    robot_model = load_robot(robot)
    return robot_model, build_judge(robot_model)


def _random_person(judge: ReferenceDistance, q: Array, rng: np.random.Generator) -> Obstacle:
    """An upright person at rest within reach, at least 5 cm from the arm at `q` (n,)."""
    while True:
        reach, turn = rng.uniform(0.45, 0.9), rng.uniform(-np.pi, np.pi)
        pose = Pose((float(reach * np.cos(turn)), float(reach * np.sin(turn)), 0.5))
        person = Obstacle(name="person", shape=PERSON, pose=pose, static=False, rank=Rank.BODY)
        if true_h(judge, q[None], [person])[0, 1] > 0.05:
            return person


def _with_limit(person: Obstacle, kind: SpeedClass) -> Obstacle:
    """The person as the filter knows her."""
    return Obstacle(
        name=person.name,
        shape=person.shape,
        pose=person.pose,
        static=False,
        rank=person.rank,
        near=kind.near if kind.knows_near else None,
    )


def _driven_loop(safety: SafetyFilter, start: Array, seed: int, steps: int) -> tuple[Array, Array, Row]:
    """Postures before each step, controls, and counts by status; the nominal control attacks the nearest rows."""
    n = len(start)
    q, after, u = start.copy(), np.empty((steps, n)), np.empty((steps, n))
    counts = safety._kernel.closed_loop(q, seed, (150, 400, 1000)[seed % 3], 0.7, after, u, np.empty(steps, np.int8))
    return np.vstack([start, after[:-1]]), u, {name: int(counts[name]) for name in STATUSES}


def _attacked_loop(
    safety: SafetyFilter, judge: ReferenceDistance, obstacles: list[Obstacle], start: Array, seed: int, steps: int
) -> tuple[Array, Array, Row]:
    """As `_driven_loop`, with an obstacle that attacks; the controls follow from the postures, which integrate them."""
    q, after = start.copy(), np.empty((steps, len(start)))
    settings = {**EXACT_ATTACK, "seed": seed, "steps": steps, "hold": (150, 400, 1000)[seed % 3]}
    counts = judge.run_worst_case_loop(safety._kernel.handles(), obstacle_rows(obstacles), settings, q, after)
    before = np.vstack([start, after[:-1]])
    u = (after - before) / safety.robot_model.period
    return before, u, dict(zip(STATUSES, map(int, counts["status"]), strict=True))
