"""Calibration of the filter to the suite's arm: agreement of the models, derated limits, tracking model.

robosuite's Panda is slower than a real one. Its joints have 0.7 to 5 kg m² of armature, so the wrist's 12 N m cannot
reach the data sheet's accelerations; and its fingertips, 10 g each with the inertia of a box of 2.4 m, have an air
drag that takes 12 N m of a hand that turns at 1 rad/s. A drive limit that the filter does not know invalidates its
guarantee. Therefore the filter is configured with lower speeds and accelerations, the same for every task and policy,
and the tracking error within them is measured in episodes of the same policies at seeds that are not counted.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import load_robot
from dualbrain.robots.model import Bound, RobotModel, TrackingErrorModel
from dualbrain.safety.cbf.filter import SafetyFilter, ToolState
from dualbrain.safety.integration.derating import derate
from dualbrain.simulation.identification.excitation import ASSUMED_ERROR, ASSUMED_LAG, ExcitationLog
from dualbrain.simulation.identification.tracking_model import fit_tracking_model
from experiments.robots.robosuite.suite_process import SuiteProcess
from experiments.robots.robosuite.virtual_environment import ENVIRONMENT

Array = NDArray[np.float64]

SPEED_SHARES = np.full(7, 0.125)
ACCELERATION_SHARES = np.array([0.25, 0.25, 0.25, 0.25, 0.25, 0.12, 0.12])
"""The filter's limits as shares of the data sheet's: within them the motors do not saturate."""
MAX_POSITION_DISAGREEMENT, MAX_ROTATION_DISAGREEMENT = 1e-3, 5e-3
"""Largest accepted differences between the two models of the arm [m], [rad]."""
N_POSTURES = 50
DRIVE = "robosuite"


def derated_robot(period: float) -> RobotModel:
    """Our Panda with the suite's period [s], derated to the suite's motors, with an assumed tracking model."""
    robot_model = load_robot("panda")
    max_speed = np.array([joint.velocity.value for joint in robot_model.joints])
    robot_model = derate(robot_model, period=period, max_speed=(SPEED_SHARES * max_speed).tolist())
    joints = tuple(
        msgspec.structs.replace(
            joint, acceleration=Bound(share * joint.acceleration.value, "rad/s^2", "suite's motors")
        )
        for joint, share in zip(robot_model.joints, ACCELERATION_SHARES.tolist(), strict=True)
    )
    robot_model = msgspec.structs.replace(robot_model, joints=joints)
    return _with_tracking(
        robot_model,
        TrackingErrorModel(
            lag=ASSUMED_LAG,
            position_error=ASSUMED_ERROR,
            rate=robot_model.alpha,
            provenance="assumed while nothing is known",
            drive=DRIVE,
        ),
    )


def calibrate(suite: SuiteProcess, run_episodes: Callable[[RobotModel], list[list[ExcitationLog]]]) -> RobotModel:
    """The robot model with the tracking model identified from `run_episodes` of the assumed model, grouped by seed.

    The tracking model is stored beside the environment for the next process, until its inputs change.
    """
    robot_model = derated_robot(suite.open("Lift", 0).period)
    path = ENVIRONMENT.folder / f"tracking-{_calibration_digest()}.json"
    if not path.exists():
        versions = ", ".join(f"{name} {version}" for name, version in suite.versions.items())
        model = fit_tracking_model(
            run_episodes(robot_model),
            robot_model.alpha,
            robot_model.period,
            source=f"{versions}: filtered episodes of seeds that are not counted",
        )
        path.write_bytes(
            msgspec.json.format(msgspec.json.encode(model.to_error_model(DRIVE, model.provenance)), indent=1)
        )
    return _with_tracking(robot_model, msgspec.json.decode(path.read_bytes(), type=TrackingErrorModel))


def model_disagreement(suite: SuiteProcess, safety: SafetyFilter, rng: np.random.Generator) -> tuple[float, float]:
    """The movement of robosuite's grip site in our tool frame over random postures [m], [rad]; a task must be open.

    Raises `ConfigurationError` if the two models are not of the same arm.
    """
    joints = safety.robot_model.joints
    low, high = np.array([j.lower.value for j in joints]), np.array([j.upper.value for j in joints])
    postures = low + (high - low) * rng.random((N_POSTURES, len(low)))
    return check_agreement(suite.grip_sites(postures), [safety.tool(q) for q in postures])


def check_agreement(sites: Array, tools: Sequence[ToolState]) -> tuple[float, float]:
    """The greatest movement [m], [rad] of `sites` (k, 12) relative to k tools.

    Raises `ConfigurationError` for more than the accepted differences.
    """
    offsets = np.array([tool.rotation.T @ (site[:3] - tool.position) for tool, site in zip(tools, sites, strict=True)])
    turns = np.array([tool.rotation.T @ site[3:].reshape(3, 3) for tool, site in zip(tools, sites, strict=True)])
    apart = float(np.linalg.norm(offsets - offsets[0], axis=1).max())
    turned = float(np.linalg.norm(turns - turns[0], axis=(1, 2)).max() / np.sqrt(2.0))
    if not (apart <= MAX_POSITION_DISAGREEMENT and turned <= MAX_ROTATION_DISAGREEMENT):
        raise ConfigurationError(
            "difference of the suite's arm from the robot model",
            got=f"{apart * 1e3:.2f} mm, {turned * 1e3:.2f} mrad",
            allowed=f"at most {MAX_POSITION_DISAGREEMENT * 1e3:g} mm, {MAX_ROTATION_DISAGREEMENT * 1e3:g} mrad",
        )
    return apart, turned


def _with_tracking(robot_model: RobotModel, tracking: TrackingErrorModel) -> RobotModel:
    return robot_model.with_tracking(tracking).with_drive(DRIVE)


def _calibration_digest() -> str:
    """Digest of the inputs of the calibration, 12 hex digits."""
    sources = [path.read_bytes() for path in sorted(Path(__file__).resolve().parent.glob("*.py"))]
    return hashlib.sha256(b"".join([ENVIRONMENT.digest.encode(), *sources])).hexdigest()[:12]
