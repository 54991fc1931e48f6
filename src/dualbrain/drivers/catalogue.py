"""Catalogue of the drivers: robot, timing, manufacturer's limits, and the function that opens each driver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

from dualbrain.drivers.driver import Driver
from dualbrain.drivers.fakes.franka import FakeFranka
from dualbrain.drivers.fakes.ur import FakeUr
from dualbrain.drivers.franka import FrankaDriver, import_franka_sdk
from dualbrain.drivers.ur import UrDriver, UrSdk
from dualbrain.drivers.vendor_limits import FR3, UR5E, VendorLimits
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.model import RobotModel
from dualbrain.safety.supervisor.timing import FRANKA, UR, Timing

PaceCallback = Callable[[float], None]


@dataclass(frozen=True, slots=True, kw_only=True)
class DriverKind:
    """A driver: the `robot` that it moves, and the manufacturer's `limits` and rated `payload` [kg].

    If `hardware` is True, a commissioning record is required. If `jerk_limits` is True, the arm aborts a motion whose
    jerk is too large, so the filter must limit the jerk. `open(address, robot_model, pace)` connects to the arm;
    `pace(now)` delays a fake to real time.
    """

    name: str
    robot: str
    hardware: bool
    timing: Timing
    limits: VendorLimits
    payload: float
    jerk_limits: bool
    open: Callable[[str, RobotModel, PaceCallback | None], Driver]


DRIVER_KINDS: tuple[DriverKind, ...] = (
    DriverKind(
        name="franka",
        robot="fr3",
        hardware=True,
        timing=FRANKA,
        limits=FR3,
        payload=3.0,
        jerk_limits=True,
        open=lambda address, robot_model, pace: FrankaDriver(import_franka_sdk(), address, robot_model),
    ),
    DriverKind(
        name="ur",
        robot="ur5e",
        hardware=True,
        timing=UR,
        limits=UR5E,
        payload=5.0,
        jerk_limits=False,
        open=lambda address, robot_model, pace: UrDriver(UrSdk(), address, robot_model),
    ),
    DriverKind(
        name="fake_franka",
        robot="fr3",
        hardware=False,
        timing=FRANKA,
        limits=FR3,
        payload=3.0,
        jerk_limits=True,
        open=lambda address, robot_model, pace: FrankaDriver(FakeFranka(robot_model, pace), address, robot_model),
    ),
    DriverKind(
        name="fake_ur",
        robot="ur5e",
        hardware=False,
        timing=UR,
        limits=UR5E,
        payload=5.0,
        jerk_limits=False,
        open=lambda address, robot_model, pace: UrDriver(FakeUr(robot_model, pace), address, robot_model),
    ),
)


def find_driver_kind(name: str, robot: str) -> DriverKind:
    """The driver called `name`, which must move `robot`; raises `UnknownNameError` or `ConfigurationError`."""
    kinds = {kind.name: kind for kind in DRIVER_KINDS}
    if name not in kinds:
        raise UnknownNameError("driver", name, tuple(kinds))
    if kinds[name].robot != robot:
        raise ConfigurationError(f"robot of driver {name}", got=robot, allowed=kinds[name].robot)
    return kinds[name]
