"""Tracking model of a mobile manipulator: separate lags of arm and base, and one error bound for both.

The base is identified along its path: its controls are compared with its displacement along the heading and its turn
(`control_displacement`), so that driving an arc is not an error. The filter uses the lag of the arm, the additional lag
of the base (`base_lag`) and the larger of the two errors.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import msgspec
import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.differential_drive import control_displacement
from dualbrain.robots.interface import Command
from dualbrain.robots.mobile_manipulator import BASE_JOINTS
from dualbrain.robots.model import RobotModel, TrackingErrorModel
from dualbrain.simulation.identification.excitation import EXCITATION_KINDS, ExcitationLog, excite
from dualbrain.simulation.identification.tracking_model import TrackingModel, fit_tracking_model
from dualbrain.simulation.plant.joint_drive import DriveKind
from dualbrain.simulation.plant.mobile_manipulator_plant import MobileManipulatorPlant
from dualbrain.simulation.scenes.scene_spec import SceneSpec

Array = NDArray[np.float64]

DRIVE_REGION = ((-30.0, -30.0), (30.0, -30.0), (30.0, 30.0), (-30.0, 30.0))
"""Corners of the room for identification [m]."""


@dataclass(frozen=True, slots=True)
class MobileTrackingModel:
    """The identified tracking models of arm and base."""

    arm: TrackingModel
    base: TrackingModel

    def to_error_model(self, drive: str, provenance: str) -> tuple[TrackingErrorModel, float]:
        """The tracking error model and the `base_lag` [s] of the robot model."""
        errors = (*self.base.position_errors, *self.arm.position_errors)
        both = msgspec.structs.replace(self.arm, position_errors=errors)
        return both.to_error_model(drive, provenance), round(self.base.lag - self.arm.lag, 6)


class SteppedMobileManipulator:
    """A mobile manipulator plant with separate steps for measuring and driving, without contacts.

    `path` (n,) is the displacement along each control [m, rad].
    """

    def __init__(self, plant: MobileManipulatorPlant) -> None:
        """Drive `plant`, which must be at rest."""
        plant.model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self.plant, self.q, self.v = plant, plant.configuration(), plant.robot_velocity()
        self.path = np.array([0.0, 0.0, *self.q[3:]])

    def measure(self) -> None:
        """Update `q` and `v`, and add the displacement since the last call to `path`."""
        self.plant.compute_dynamics()
        now = self.plant.configuration()
        self.path = self.path + control_displacement(self.q, now)
        self.q, self.v = now, self.plant.robot_velocity()

    def apply(self, u: Array) -> None:
        """Drive at u (n,) [m/s, rad/s] for one control period."""
        grip = self.plant.robot_model.gripper
        self.plant.write(Command(u, grip.opening.value, grip.force_min.value))
        self.plant.actuate()
        for _ in range(self.plant.steps_per_period - 1):
            self.plant.step()


def identify_mobile_manipulator(
    robot_model: RobotModel,
    drive: DriveKind = "computed_torque",
    *,
    load: float = 0.5,
    seeds: Sequence[int] = (0, 1, 2, 3),
    seconds: float = 10.0,
    progress: Callable[[float, str], None] | None = None,
) -> MobileTrackingModel:
    """Identify arm and base from the same runs, with an empty hand and with `load` [kg] at the tool.

    `seconds` is the duration of each run; `progress` receives the finished share and a description.
    """
    spec, steps = (
        SceneSpec(
            robot=robot_model.name, family="identify", seed=0, objects=(), places=(), mover=None, region=DRIVE_REGION
        ),
        round(seconds / robot_model.period),
    )
    loads = (0.0, load) if load > 0.0 else (0.0,)
    runs = [(kg, kind) for kg in loads for kind in EXCITATION_KINDS]
    logs: list[list[ExcitationLog]] = []
    for seed in seeds:
        own: list[ExcitationLog] = []
        for kg, kind in runs:
            if progress is not None:
                progress((len(logs) * len(runs) + len(own)) / (len(seeds) * len(runs)), f"seed {seed}, {kind}")
            plant = SteppedMobileManipulator(MobileManipulatorPlant(spec, robot_model, drive=drive, load=kg))
            own.append(excite(plant, robot_model, kind, steps, np.random.default_rng(seed)))
        logs.append(own)
    source = f"{robot_model.name}, {len(seeds)} seeds x {', '.join(EXCITATION_KINDS)} x {seconds:g} s, loads {loads} kg"
    parts = (slice(BASE_JOINTS, None), slice(0, BASE_JOINTS))
    arm, base = (
        fit_tracking_model(
            [[_slice_log(log, part) for log in own] for own in logs],
            robot_model.alpha,
            robot_model.period,
            source=source,
        )
        for part in parts
    )
    return MobileTrackingModel(arm, base)


def _slice_log(log: ExcitationLog, part: slice) -> ExcitationLog:
    return ExcitationLog(log.q[:, part], log.v[:, part], log.u[:, part])
