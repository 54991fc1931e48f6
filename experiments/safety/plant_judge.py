"""Distances between the plant's own collision shapes, by MuJoCo in float64, independent of the filter's spheres."""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.model import RobotModel
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_builder import ROBOT_PREFIX

Array = NDArray[np.float64]
EXACT_DISTANCE_RANGE = 0.08
"""Pairs whose bounding spheres are farther apart are not measured exactly [m]."""
REMEASURE_RANGE = 0.03
"""Pairs that may be this close are measured together with those that are due [m]."""
MAX_TOOL_REACH = 0.35
"""No point of link 7, hand and fingers is farther from the last joint's origin [m]."""


class PlantJudge:
    """Smallest distances between the arm's shapes and the scene, and between the arm's own links, at every state.

    Distances are measured again whenever a pair could have touched since the last measurement. In every period, the
    longest path of any point of the arm, Σ_k |Δq_k| times the longest lever arm of joint k, is subtracted from the
    smallest distance. When nothing is left, every pair loses the paths of its shapes' centres and the largest rotation
    about them, and the pairs with little left are measured. Thus no state with a negative distance is missed, and every
    reported distance was measured.
    """

    def __init__(self, plant: Plant) -> None:
        """All pairs of `plant` that the filter keeps apart; the base is fixed and cannot touch the scene."""
        self._model, self._data, robot_model = plant.model, plant.data, plant.robot_model
        frames = {link.name: link.frame for link in robot_model.links}
        arm = {g: frames[name] for g in range(self._model.ngeom) if (name := self._link_name(g)) in frames}
        scene = [g for g in range(self._model.ngeom) if g not in arm]
        moving = [g for g, frame in arm.items() if frame > 0]
        own = _self_pairs(arm, {g: self._link_name(g) for g in arm}, robot_model)
        self._pairs = np.array([*((g, s) for g in moving for s in scene), *own])
        self._n_scene = len(moving) * len(scene)
        self._share = np.where(
            np.arange(len(self._pairs)) < self._n_scene, 1.0, 0.5
        )  # in a pair of links both may move
        self._bounds = self._model.geom_rbound * np.isin(np.arange(self._model.ngeom), moving)
        self._reach = self._model.geom_rbound[self._pairs].sum(axis=1)
        self._plane = self._model.geom_rbound[self._pairs].min(axis=1) <= 0.0  # planes have no bounding sphere
        self._q, self._positions = plant.data.qpos[plant.arm_slices[0]], plant.data.geom_xpos
        self._last, self._last_q, self._last_positions = self._q.copy(), self._q.copy(), self._positions.copy()
        self._lever_arms = _longest_lever_arms(robot_model)
        self._slack, self._remaining_travel = np.zeros(len(self._pairs)), 0.0
        self.min_scene_distance, self.min_self_distance, self.n_below_zero, self.n_measurements = np.inf, np.inf, 0, 0

    def update(self) -> None:
        """Judge the present poses of the plant."""
        self._remaining_travel -= float(np.abs(self._q - self._last) @ self._lever_arms)
        self._last[:] = self._q
        if self._remaining_travel <= 0.0:
            turned = float(np.abs(self._q - self._last_q).sum())
            moved = np.sqrt(((self._positions - self._last_positions) ** 2).sum(axis=1)) + turned * self._bounds
            self._slack -= moved[self._pairs].sum(axis=1)
            self._last_positions[:], self._last_q[:] = self._positions, self._q
            self._measure(np.flatnonzero(self._slack <= REMEASURE_RANGE))
            self._remaining_travel = float((self._slack * self._share).min())

    def _measure(self, due: NDArray[np.intp]) -> None:
        at = self._positions[self._pairs[due]]
        bound = np.sqrt(((at[:, 0] - at[:, 1]) ** 2).sum(axis=1)) - self._reach[due]
        bound[self._plane[due]] = -1.0
        self._slack[due] = bound
        least = np.inf
        for pair in due[bound <= EXACT_DISTANCE_RANGE].tolist():
            a, b = self._pairs[pair].tolist()
            h = mujoco.mj_geomDistance(self._model, self._data, a, b, 1.0, None)
            self._slack[pair] = h
            self.n_measurements += 1
            least = min(least, h)
            if pair < self._n_scene:
                self.min_scene_distance = min(self.min_scene_distance, h)
            else:
                self.min_self_distance = min(self.min_self_distance, h)
        self.n_below_zero += least < 0.0

    def _link_name(self, geom: int) -> str:
        name = self._model.body(int(self._model.geom_bodyid[geom])).name
        return name.removeprefix(ROBOT_PREFIX) if name.startswith(ROBOT_PREFIX) else ""


def _longest_lever_arms(robot_model: RobotModel) -> Array:
    """The longest lever arm (n,) of each joint to any point of arm, hand and fingers, in any posture [m]."""
    lengths = [float(np.linalg.norm(joint.translation)) for joint in robot_model.joints]
    return np.array([sum(lengths[k + 1 :]) + MAX_TOOL_REACH for k in range(robot_model.n)])


def _self_pairs(arm: dict[int, int], links: dict[int, str], robot_model: RobotModel) -> list[tuple[int, int]]:
    """Pairs of shapes of links that are kept apart, the link nearer to the base first."""
    kept = {frozenset(pair) for pair in robot_model.self_pairs.kept}
    return [(a, b) for a in arm for b in arm if arm[a] < arm[b] and frozenset((links[a], links[b])) in kept]
