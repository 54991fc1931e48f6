"""The judge: does a link of the arm overlap anything but the ignored bodies, in every step of the simulation?

It has a copy of the MuJoCo model in which every mesh of the arm collides, also those that do not in the suite, and
reads joint positions from the simulation and nothing from the filter. MuJoCo takes a mesh as its convex hull. A pair
that overlaps at the start counts from the first moment at which it does not.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import copy
from collections.abc import Collection
from typing import Any

import mujoco
import numpy as np

ARM = 2
"""The bit of `contype` of the arm and of `conaffinity` of all others: nothing else collides."""


class ContactJudge:
    """Depth [m] and time [s] of the overlaps of each pair of bodies; `at_start` are the pairs of the first update.

    `first` is the first body that moves with the arm, `robot` the root of the whole robot: its other bodies and those
    in `ignored` do not count.
    """

    def __init__(self, model: Any, *, first: str, robot: str, ignored: Collection[str]) -> None:
        self._model, self.depth, self.time = copy.deepcopy(model), dict[str, float](), dict[str, float]()
        self.at_start: set[str] | None = None
        self._ignored: set[str] | None = None
        self._data = mujoco.MjData(self._model)
        arm, own = (_carried(model, model.body(name).id) for name in (first, robot))
        free = {model.body(name).id for name in ignored if name in _body_names(model)}
        hard = (model.geom_contype != 0) | (model.geom_conaffinity != 0)
        meshes = model.geom_type == mujoco.mjtGeom.mjGEOM_MESH
        for geom, body in enumerate(map(int, model.geom_bodyid)):
            is_arm = body in arm and (hard[geom] or meshes[geom])
            is_other = hard[geom] and body not in own and body not in free
            self._model.geom_contype[geom] = ARM if is_arm else 0
            self._model.geom_conaffinity[geom] = ARM if is_other else 0
        self._model.body_contype[:] = self._model.body_conaffinity[:] = ARM  # the first test of a pair of bodies
        self._model.opt.disableflags = int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)  # the first link and a fixed table

    def update(self, data: Any) -> None:
        """Judge the present state of the simulation."""
        mine = self._data
        mine.qpos[:], mine.mocap_pos[:], mine.mocap_quat[:] = data.qpos, data.mocap_pos, data.mocap_quat
        mujoco.mj_kinematics(self._model, mine)
        mujoco.mj_comPos(self._model, mine)
        mujoco.mj_collision(self._model, mine)
        depths: dict[str, float] = {}
        for index in range(mine.ncon):
            if (depth := -float(mine.contact[index].dist)) >= 0.0:
                pair = self._pair(mine.contact[index])
                depths[pair] = max(depths.get(pair, 0.0), depth)
        self._ignored = set(depths) if self._ignored is None else self._ignored & set(depths)
        self.at_start = set(depths) if self.at_start is None else self.at_start
        for pair, depth in depths.items():
            if pair not in self._ignored:
                self.depth[pair] = max(self.depth.get(pair, 0.0), depth)
                self.time[pair] = self.time.get(pair, 0.0) + float(self._model.opt.timestep)

    def _pair(self, contact: Any) -> str:
        """The link and the other body."""
        first, second = (int(geom) for geom in np.asarray(contact.geom))
        arm, other = (first, second) if self._model.geom_contype[first] == ARM else (second, first)
        bodies = [self._model.body(int(self._model.geom_bodyid[geom])).name for geom in (arm, other)]
        return " and ".join(name.removeprefix("robot0:") for name in bodies)


def _carried(model: Any, first: int) -> set[int]:
    """The body `first` and all bodies that it carries."""
    found = {first}
    for body in range(first + 1, model.nbody):
        if int(model.body_parentid[body]) in found:
            found.add(body)
    return found


def _body_names(model: Any) -> set[str]:
    return {model.body(body).name for body in range(model.nbody)}
