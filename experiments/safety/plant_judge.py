"""Distances on the plant's own collision shapes, by MuJoCo in float64; no spheres, nothing of the filter."""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.model import Body
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.scene_builder import PREFIX

Array = NDArray[np.float64]
FAR = 0.08
"""Pairs whose bounding balls are farther apart are not measured exactly [m]."""
SOON = 0.03
"""Pairs that may be this near are measured together with those that are due [m]."""
BEYOND = 0.35
"""No point of link 7, hand and fingers is farther from the last joint's origin [m]."""


class PlantJudge:
    """Least distance between the arm's shapes and the scene's, and between its own parts, state by state.

    Distances are measured anew whenever some pair could have met since: from the least distance is taken, period by
    period, the longest way of any point of the arm, Σ_k |Δq_k| times the longest lever arm of joint k. Then every pair
    loses how far the centres of its parts went and how far a point of them can have turned about its centre, and what
    is left with little is measured. So no state with a distance below zero escapes, and every distance that is
    reported was measured.
    """

    def __init__(self, plant: Plant) -> None:
        """All pairs of `plant` that the filter keeps apart; the base is bolted down and meets no scene."""
        self._model, self._data, body = plant.model, plant.data, plant.body
        frames = {link.name: link.frame for link in body.links}
        arm = {g: frames[name] for g in range(self._model.ngeom) if (name := self._link(g)) in frames}
        scene = [g for g in range(self._model.ngeom) if g not in arm]
        moving = [g for g, frame in arm.items() if frame > 0]
        own = _own_pairs(arm, {g: self._link(g) for g in arm}, body)
        self._pairs = np.array([*((g, s) for g in moving for s in scene), *own])
        self._n_scene = len(moving) * len(scene)
        self._share = np.where(np.arange(len(self._pairs)) < self._n_scene, 1.0, 0.5)  # in own pairs both may move
        self._bounds = self._model.geom_rbound * np.isin(np.arange(self._model.ngeom), moving)
        self._reach = self._model.geom_rbound[self._pairs].sum(axis=1)
        self._plane = self._model.geom_rbound[self._pairs].min(axis=1) <= 0.0  # planes have no bounding ball
        self._q, self._at = plant.data.qpos[plant.arm_slices[0]], plant.data.geom_xpos
        self._last, self._last_q, self._last_at = self._q.copy(), self._q.copy(), self._at.copy()
        self._levers = _levers(body)
        self._slack, self._room = np.zeros(len(self._pairs)), 0.0
        self.least, self.least_own, self.below, self.looks = np.inf, np.inf, 0, 0

    def look(self) -> None:
        """Judge the poses that the plant holds now."""
        self._room -= float(np.abs(self._q - self._last) @ self._levers)
        self._last[:] = self._q
        if self._room <= 0.0:
            turned = float(np.abs(self._q - self._last_q).sum())
            moved = np.sqrt(((self._at - self._last_at) ** 2).sum(axis=1)) + turned * self._bounds
            self._slack -= moved[self._pairs].sum(axis=1)
            self._last_at[:], self._last_q[:] = self._at, self._q
            self._measure(np.flatnonzero(self._slack <= SOON))
            self._room = float((self._slack * self._share).min())

    def _measure(self, due: NDArray[np.intp]) -> None:
        at = self._at[self._pairs[due]]
        bound = np.sqrt(((at[:, 0] - at[:, 1]) ** 2).sum(axis=1)) - self._reach[due]
        bound[self._plane[due]] = -1.0
        self._slack[due] = bound
        least = np.inf
        for pair in due[bound <= FAR].tolist():
            a, b = self._pairs[pair].tolist()
            h = mujoco.mj_geomDistance(self._model, self._data, a, b, 1.0, None)
            self._slack[pair] = h
            self.looks += 1
            least = min(least, h)
            if pair < self._n_scene:
                self.least = min(self.least, h)
            else:
                self.least_own = min(self.least_own, h)
        self.below += least < 0.0

    def _link(self, geom: int) -> str:
        name = self._model.body(int(self._model.geom_bodyid[geom])).name
        return name.removeprefix(PREFIX) if name.startswith(PREFIX) else ""


def _levers(body: Body) -> Array:
    """Longest lever arm (n,) of each joint on any point of the arm, hand and fingers in any posture [m]."""
    lengths = [float(np.linalg.norm(joint.translation)) for joint in body.joints]
    return np.array([sum(lengths[k + 1 :]) + BEYOND for k in range(body.n)])


def _own_pairs(arm: dict[int, int], links: dict[int, str], body: Body) -> list[tuple[int, int]]:
    """Shapes of link pairs that are kept apart, the one nearer to the base first."""
    kept = {frozenset(pair) for pair in body.self_pairs.kept}
    return [(a, b) for a in arm for b in arm if arm[a] < arm[b] and frozenset((links[a], links[b])) in kept]
