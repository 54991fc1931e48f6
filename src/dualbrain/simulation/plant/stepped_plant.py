"""A plant driven by joint velocities alone, in two halves, look and drive: for identifying and judging."""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.interface import Command
from dualbrain.simulation.plant.plant import Plant

Array = NDArray[np.float64]


class SteppedPlant:
    """`sense()` makes everything current, `act(u)` drives for one control period; the fingers stay open.

    Contacts may be left out (`contacts=False`): nothing is touched in a loop that judges distances.
    """

    def __init__(self, plant: Plant, *, contacts: bool = True) -> None:
        """`plant` with its own drive."""
        self.plant, self._gripper = plant, plant.robot_model.gripper
        q, v = plant.arm_slices
        self.q, self.v = plant.data.qpos[q], plant.data.qvel[v]
        """Joint positions and velocities (n,), views of the state."""
        if not contacts:
            plant.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)

    def measure(self) -> None:
        """Make poses, inertia and bias those of the state now."""
        self.plant.compute_dynamics()

    def apply(self, u: Array) -> None:
        """Drive at joint velocity u (n,) [rad/s] for one control period."""
        self.plant.write(Command(u, self._gripper.opening.value, self._gripper.force_min.value))
        self.plant.actuate()
        for _ in range(self.plant.steps_per_period - 1):
            self.plant.step()
