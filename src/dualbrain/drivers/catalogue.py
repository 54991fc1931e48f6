"""Which drivers there are, for which bodies, and what has to hold before one is opened."""

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
    """A driver by `name`: the `robot` that it moves, its `limits` and rated `payload` [kg] by the maker.

    `hardware` demands commissioning; `jerk_limits` says that the arm refuses a jerk that the filter must keep within.
    `open(address, body, pace)` connects; `pace(now)` holds a fake back to real time.
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
    """The driver called `name` for `robot`; raises `UnknownName`, or `InvalidSetup` for another robot."""
    kinds = {kind.name: kind for kind in DRIVER_KINDS}
    if name not in kinds:
        raise UnknownNameError("driver", name, tuple(kinds))
    if kinds[name].robot != robot:
        raise ConfigurationError(f"robot of driver {name}", got=robot, allowed=kinds[name].robot)
    return kinds[name]
