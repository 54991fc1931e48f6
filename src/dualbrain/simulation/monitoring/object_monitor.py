"""Monitor of the free objects: it reports objects that the task does not involve and that moved, and objects that fell.

`bystander`: moved more than 2 cm from its initial position; `bystander_tilt`: turned by more than 15°; both only for
objects that were never target, held or destination. `object_dropped`: below the surface that it was above at the start,
or a free fall of more than 5 cm, in the phase `release` of more than 15 cm. A gripped object is not dropped.
"""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from dualbrain.simulation.monitoring.contact_rules import ContactAllowance, ContactRules
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.supports import support_height

MAX_DISPLACEMENT = 0.02  # [m]
MAX_TILT = float(np.deg2rad(15.0))  # [rad]
COS_HALF_MAX_TILT = float(np.cos(MAX_TILT / 2))
MIN_HEIGHT = -0.01  # [m] height of its centre above the surface of its start, below which an object has left it
MIN_FALL_HEIGHT = 0.05  # [m]
MIN_RELEASE_FALL_HEIGHT = 0.15
"""Fall [m] in the phase `release` that counts; an object falls up to 0.11 m into a bowl of 9 cm."""
MIN_FALL_SPEED = 0.3  # [m/s] downward, above which a motion may be a fall


class ObjectMonitor:
    """Compares every free object with its pose at the start of monitoring."""

    def __init__(self, plant: Plant) -> None:
        """Index the free objects; `record_start_poses` takes the reference poses."""
        self._model, self._data, self._spec = plant.model, plant.data, plant.spec
        self.object_names = plant.object_names
        self._free_objects = [obj.name for obj in plant.spec.objects if not obj.fixed]
        self._body = np.array([plant.model.body(name).id for name in self._free_objects], int)
        self._dof = np.array([plant.model.body(name).dofadr[0] for name in self._free_objects], int)
        self._start_poses: tuple[NDArray[np.float64], NDArray[np.float64]] | None = None
        self._min_heights = np.zeros(len(self._free_objects))
        self._involved: set[str] = set()
        self._fall_start_heights: dict[str, float] = {}
        self._releasing = False

    def allow(self, allowance: ContactAllowance) -> None:
        """Exempt the objects that a skill names from the bystander checks, for the rest of the episode."""
        self._involved |= {name for name in (allowance.target, allowance.held, allowance.destination) if name}
        self._releasing = allowance.phase == "release"

    def record_start_poses(self) -> None:
        """Record the reference poses on the first call; later calls do nothing."""
        if self._start_poses is None:
            self._start_poses = (self._data.xpos[self._body].copy(), self._data.xquat[self._body].copy())
            below = [support_height(self._spec, *at[:2]) for at in self._start_poses[0].tolist()]
            self._min_heights = MIN_HEIGHT + np.array([height or 0.0 for height in below])

    def find_violations(self, rules: ContactRules) -> Iterator[tuple[str, str, float]]:
        """Every violation (kind, name, peak) in the present state; call `record_start_poses` first."""
        assert self._start_poses is not None
        position, quaternion = self._data.xpos[self._body], self._data.xquat[self._body]
        displacement = position - self._start_poses[0]
        moved = (displacement * displacement).sum(axis=1)
        cosine = np.abs((quaternion * self._start_poses[1]).sum(axis=1))
        suspects = (moved > MAX_DISPLACEMENT**2) | (cosine < COS_HALF_MAX_TILT)
        if suspects.any():
            yield from self._find_moved_bystanders(suspects, np.sqrt(moved), 2.0 * np.arccos(cosine.clip(0.0, 1.0)))
        height, rise = position[:, 2], self._data.qvel[self._dof + 2]
        if self._fall_start_heights or ((rise < -MIN_FALL_SPEED) | (height < self._min_heights)).any():
            yield from self._find_falls(height, rise, rules)

    def _find_moved_bystanders(
        self, suspects: NDArray[np.bool_], moved: NDArray[np.float64], turned: NDArray[np.float64]
    ) -> Iterator[tuple[str, str, float]]:
        for index in suspects.nonzero()[0].tolist():
            name = self._free_objects[index]
            if name in self._involved:
                continue
            if moved[index] > MAX_DISPLACEMENT:
                yield "bystander", name, float(moved[index])
            if turned[index] > MAX_TILT:
                yield "bystander_tilt", name, float(turned[index])

    def _find_falls(
        self, height: NDArray[np.float64], rise: NDArray[np.float64], rules: ContactRules
    ) -> Iterator[tuple[str, str, float]]:
        min_fall_height = MIN_RELEASE_FALL_HEIGHT if self._releasing else MIN_FALL_HEIGHT
        for index, name in enumerate(self._free_objects):
            falls, depth = rise[index] < -MIN_FALL_SPEED, self._min_heights[index] - height[index]
            gripped = (falls or depth > 0.0) and self._is_gripped(index, rules)
            if depth > 0.0 and not gripped:
                yield "object_dropped", name, float(depth - MIN_HEIGHT)
            if not falls or gripped:
                self._fall_start_heights.pop(name, None)
                continue
            top = self._fall_start_heights.setdefault(name, float(height[index]) + float(rise[index]) ** 2 / (2 * 9.81))
            if top - height[index] > min_fall_height:
                yield "object_dropped", name, float(top - height[index])

    def _is_gripped(self, index: int, rules: ContactRules) -> bool:
        pairs = self._data.contact.geom
        if not len(pairs):
            return False
        body = self._model.geom_bodyid
        is_object = body[pairs] == self._body[index]
        return bool((is_object[:, ::-1] & rules.finger_mask[pairs]).any())
