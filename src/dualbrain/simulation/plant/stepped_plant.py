"""A plant driven by joint velocities, with separate steps for measuring and driving; for identification and checks."""

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
    """`measure()` updates the state, `apply(u)` drives for one control period; the fingers stay open.

    `contacts=False` disables contacts, for loops that check distances only.
    """

    def __init__(self, plant: Plant, *, contacts: bool = True) -> None:
        """Drive `plant` with its own drive."""
        self.plant, self._gripper = plant, plant.robot_model.gripper
        q, v = plant.arm_slices
        self.q, self.v = plant.data.qpos[q], plant.data.qvel[v]
        """Joint positions [rad] and velocities [rad/s], shape (n,), views of the simulator's state."""
        if not contacts:
            plant.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)

    def measure(self) -> None:
        """Compute poses, inertia and bias torque for the present state."""
        self.plant.compute_dynamics()

    def apply(self, u: Array) -> None:
        """Drive at joint velocities u (n,) [rad/s] for one control period."""
        self.plant.write(Command(u, self._gripper.opening.value, self._gripper.force_min.value))
        self.plant.actuate()
        for _ in range(self.plant.steps_per_period - 1):
            self.plant.step()
