"""Judge of contacts in the simulation of gym-aloha, in every step of MuJoCo; it knows nothing of the filter.

The module needs only NumPy and MuJoCo.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

KINDS = ("arm and arm", "hand and hand", "arm and table", "hand and table", "arm and object", "within one arm")
"""Kinds of contacts: a hand is a gripper with its fingers, an arm any other link; the hand may touch objects."""
HAND_PARTS = ("gripper", "finger")


class ContactJudge:
    """Peak normal force [N] and time [s] of every kind of contact of one episode."""

    def __init__(self, model: Any, data: Any) -> None:
        self._model, self._data, self._force = model, data, np.zeros(6)
        self._parts = [_part_of(model.body(int(body)).name) for body in model.geom_bodyid]
        self.peaks: dict[str, float] = {}
        self.times: dict[str, float] = {}

    def update(self) -> None:
        """Judge the contacts of the present step of the simulation."""
        present: set[str] = set()
        for index in range(self._data.ncon):
            contact = self._data.contact[index]
            kind = kind_of(self._parts[contact.geom1], self._parts[contact.geom2])
            if not kind or contact.dist > 0.0:
                continue
            mujoco.mj_contactForce(self._model, self._data, index, self._force)
            self.peaks[kind] = max(self.peaks.get(kind, 0.0), abs(float(self._force[0])))
            present.add(kind)
        for kind in present:
            self.times[kind] = self.times.get(kind, 0.0) + float(self._model.opt.timestep)


Part = tuple[str, str]
"""Side ("left", "right", or "" for anything else) and part: "hand", "arm", "table" or "object"."""


def _part_of(body: str) -> Part:
    for side in ("left", "right"):
        prefix = f"vx300s_{side}/"
        if body.startswith(prefix):
            link = body.removeprefix(prefix)
            return side, "hand" if any(part in link for part in HAND_PARTS) else "arm"
    return "", "table" if body == "table" else "object"


def kind_of(one: Part, other: Part) -> str:
    """The kind of a contact of two parts, or "" if it does not count."""
    (side, part), (other_side, other_part) = sorted((one, other), reverse=True)
    if not side:
        return ""
    if not other_side:
        return "" if (part, other_part) == ("hand", "object") else f"{part} and {other_part}"
    if side == other_side:
        return "" if part == other_part == "hand" else "within one arm"
    return "hand and hand" if part == other_part == "hand" else "arm and arm"
