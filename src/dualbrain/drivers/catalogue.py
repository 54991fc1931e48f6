"""Catalogue of the drivers: robot, timing, manufacturer's limits, and the function that opens each driver."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

from dualbrain.drivers.driver import Driver
from dualbrain.drivers.fakes.franka import FakeFranka
from dualbrain.drivers.fakes.ur import FakeUr
from dualbrain.drivers.franka import FrankaDriver, Realtime, import_franka_sdk
from dualbrain.drivers.ur import UrDriver, UrSdk
from dualbrain.drivers.vendor_limits import FR3, UR5E, VendorLimits
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.model import RobotModel
from dualbrain.safety.supervisor.timing import FRANKA, UR, Timing

PaceCallback = Callable[[float], None]


class OpenDriver(Protocol):
    """Connects to an arm."""

    def __call__(
        self, address: str, robot_model: RobotModel, pace: PaceCallback | None, *, realtime: Realtime = "enforce"
    ) -> Driver:
        """The open driver; `pace(now)` delays a fake to real time."""
        ...


@dataclass(frozen=True, slots=True, kw_only=True)
class DriverKind:
    """A driver: the `robot` that it moves, and the manufacturer's `limits` and rated `payload` [kg].

    If `hardware` is True, a commissioning record is required. If `jerk_limits` is True, the arm aborts a motion whose
    jerk is too large, so the filter must limit the jerk. `open` connects to the arm. `realtime_option`: whether the
    manufacturer's library has an option to accept a kernel without PREEMPT_RT.
    """

    name: str
    robot: str
    hardware: bool
    timing: Timing
    limits: VendorLimits
    payload: float
    jerk_limits: bool
    open: OpenDriver
    realtime_option: bool = False

    def check_realtime(self, realtime: str) -> Realtime:
        """`realtime` as an option of this driver.

        Raises `ConfigurationError` for another word, and for "ignore" if the driver has no such option.
        """
        if realtime == "enforce":
            return "enforce"
        if realtime != "ignore":
            raise ConfigurationError("realtime", got=realtime, allowed="'enforce' or 'ignore'")
        if not self.realtime_option:
            raise ConfigurationError.stating(
                f"The driver {self.name} has no option for the real-time kernel.", fix="Leave `--realtime` out."
            )
        return "ignore"


def _open_franka(
    address: str, robot_model: RobotModel, pace: PaceCallback | None, *, realtime: Realtime = "enforce"
) -> Driver:
    del pace
    return FrankaDriver(import_franka_sdk(), address, robot_model, realtime=realtime)


def _open_fake_franka(
    address: str, robot_model: RobotModel, pace: PaceCallback | None, *, realtime: Realtime = "enforce"
) -> Driver:
    return FrankaDriver(FakeFranka(robot_model, pace), address, robot_model, realtime=realtime)


def _open_ur(
    address: str, robot_model: RobotModel, pace: PaceCallback | None, *, realtime: Realtime = "enforce"
) -> Driver:
    del pace, realtime
    return UrDriver(UrSdk(), address, robot_model)


def _open_fake_ur(
    address: str, robot_model: RobotModel, pace: PaceCallback | None, *, realtime: Realtime = "enforce"
) -> Driver:
    del realtime
    return UrDriver(FakeUr(robot_model, pace), address, robot_model)


DRIVER_KINDS: tuple[DriverKind, ...] = (
    DriverKind(
        name="franka",
        robot="fr3",
        hardware=True,
        timing=FRANKA,
        limits=FR3,
        payload=3.0,
        jerk_limits=True,
        open=_open_franka,
        realtime_option=True,
    ),
    DriverKind(
        name="ur",
        robot="ur5e",
        hardware=True,
        timing=UR,
        limits=UR5E,
        payload=5.0,
        jerk_limits=False,
        open=_open_ur,
    ),
    DriverKind(
        name="fake_franka",
        robot="fr3",
        hardware=False,
        timing=FRANKA,
        limits=FR3,
        payload=3.0,
        jerk_limits=True,
        open=_open_fake_franka,
        realtime_option=True,
    ),
    DriverKind(
        name="fake_ur",
        robot="ur5e",
        hardware=False,
        timing=UR,
        limits=UR5E,
        payload=5.0,
        jerk_limits=False,
        open=_open_fake_ur,
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
