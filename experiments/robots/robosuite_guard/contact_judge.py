"""The judge: contacts of the arm in robosuite's simulation, in every step of the physics.

It reads names and contacts from MuJoCo, and nothing from the filter or its obstacles.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

ALLOWED = {"Lift": "cube_main", "Stack": "cubeA_main", "PickPlaceCan": "Can_main"}
"""The body that the arm may touch in each task."""


class ContactJudge:
    """Contacts with a force between the arm or its hand and anything but the manipulated object."""

    def __init__(self, env: Any, task: str) -> None:
        self._model, self._data = env.sim.model._model, env.sim.data._data
        names = [self._model.body(int(body)).name for body in self._model.geom_bodyid]
        self._names = [name.removeprefix("robot0_").removeprefix("gripper0_right_") for name in names]
        self._own = np.array([name.startswith(("robot0_", "gripper0_")) for name in names])
        self._finger = np.array(["finger" in name for name in names])
        self._allowed = np.array([name == ALLOWED[task] for name in names])
        self.outside: dict[str, float] = {}
        self.between_links: dict[str, float] = {}
        self._wrench = np.zeros(6)

    def update(self) -> None:
        """Judge the present contacts; of each pair of bodies the largest normal force [N] counts."""
        for index in range(self._data.ncon):
            one, other = (int(geom) for geom in self._data.contact[index].geom)
            if self._allowed[one] or self._allowed[other] or not (self._own[one] or self._own[other]):
                continue
            own = bool(self._own[one] and self._own[other])
            if own and self._finger[one] and self._finger[other]:
                continue
            mujoco.mj_contactForce(self._model, self._data, index, self._wrench)
            if (force := float(self._wrench[0])) > 0.0:
                pair = " and ".join(sorted((self._names[one], self._names[other])))
                found = self.between_links if own else self.outside
                found[pair] = max(found.get(pair, 0.0), round(force, 2))
