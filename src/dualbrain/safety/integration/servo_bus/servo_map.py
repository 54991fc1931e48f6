"""Names and units of the servos of an arm: readings and commands by name, in degrees, as joint positions in radians.

    q_i = s_i (value_i − offset_i) π/180

with the sign s_i and the offset of the calibration of each joint. A mapping may have its names in any order.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from math import isfinite
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.model import RobotModel

Array = NDArray[np.float64]

MAX_SHOWN_NAMES = 12
RANGE_TOLERANCE = 0.09
"""Distance [rad] beyond a joint limit at which a reading contradicts the robot model (5°)."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoCalibration:
    """Calibration of one joint: the `key` of its servo ("" for the name of the joint), sign and offset [deg].

    `offset` is the value of the servo in the zero position of the robot model.
    """

    key: str = ""
    sign: int = 1
    offset: float = 0.0

    def __post_init__(self) -> None:
        """Check sign and offset."""
        if self.sign not in (1, -1):
            raise ConfigurationError("sign of a servo", got=self.sign, allowed="1 or -1")
        if not isfinite(self.offset):
            raise ConfigurationError("offset of a servo [deg]", got=self.offset, allowed="a finite number")


@dataclass(frozen=True, slots=True, kw_only=True)
class ServoMap:
    """The servos of `robot_model`: the `keys` of its joints in order, and of the `passed` servos (grippers).

    `signs`, `offsets` (n,) [deg] are the calibration. Implements the layout of a `PolicyGuard`.
    """

    robot_model: RobotModel
    keys: tuple[str, ...]
    passed: tuple[str, ...]
    signs: Array = field(repr=False)
    offsets: Array = field(repr=False)

    @classmethod
    def of(
        cls,
        robot_model: RobotModel,
        keys: Sequence[str],
        *,
        calibration: Mapping[str, ServoCalibration] | None = None,
        suffix: str = ".pos",
    ) -> ServoMap:
        """The map to the servos `keys` of a robot ("shoulder_pan.pos"); those without a joint pass unchanged.

        `calibration` is by the name of the joint; `suffix` follows the names of the servos in their keys.

        Raises:
            UnknownNameError: `calibration` names no joint of the robot model.
            ConfigurationError: a joint has no servo, or two have the same.
        """
        names = [joint.name for joint in robot_model.joints]
        given = calibration or {}
        for name in given:
            if name not in names:
                raise UnknownNameError("calibrated joint", name, tuple(names), owner=robot_model.name)
        entries = [given.get(name, ServoCalibration()) for name in names]
        own = tuple(f"{entry.key or name}{suffix}" for name, entry in zip(names, entries, strict=True))
        missing = [key for key in own if key not in keys]
        if missing or len(set(own)) != len(own):
            raise ConfigurationError.stating(
                f"The joints of {robot_model.name} need the servos {_listed(own)}; the robot has {_listed(keys)}.",
                fix="Name the servo of each joint in the calibration, and choose the model of this robot.",
            )
        return cls(
            robot_model=robot_model,
            keys=own,
            passed=tuple(key for key in keys if key not in own),
            signs=np.array([float(entry.sign) for entry in entries]),
            offsets=np.array([entry.offset for entry in entries]),
        )

    def check(self, count: int) -> None:
        """Raise `ConfigurationError` if the map does not fit `count` joints."""
        if count != len(self.keys):
            raise ConfigurationError("servos", got=len(self.keys), allowed=f"{count}, one for each joint")

    def read(self, action: Any, count: int, size: int | None) -> Array | str:
        """The joint positions (n,) [rad] that `action` commands, or why it is unusable."""
        del count, size
        problem = self.find_problem(action)
        return problem or self.positions(action)

    def write(self, values: Array, action: Mapping[str, Any]) -> dict[str, Any]:
        """A copy of `action` with the joint positions `values` (n,) [rad]; all other entries as they are."""
        return {**action, **self.values(values)}

    def find_problem(self, given: object) -> str:
        """Why the action `given` is unusable; "" if it names every joint, only known servos, and finite numbers."""
        if not isinstance(given, Mapping):
            return f"the action is no mapping of servo names but {type(given).__name__}"
        action = cast("Mapping[str, Any]", given)
        missing = [key for key in self.keys if key not in action]
        if missing:
            return f"the action lacks {_listed(missing)}"
        unknown = [key for key in action if key not in self.keys and key not in self.passed]
        if unknown:
            return f"the action names {_listed(unknown)}; the robot has {_listed((*self.keys, *self.passed))}"
        bad = [key for key, value in action.items() if not _is_finite(value)]
        return f"the value of {_listed(bad)} in the action is no finite number" if bad else ""

    def read_positions(self, reading: object) -> Array:
        """Joint positions (n,) [rad] of a reading, NaN where it has none; also of one that is no mapping."""
        return self.positions(cast("Mapping[str, Any]", reading) if isinstance(reading, Mapping) else {})

    def positions(self, values: Mapping[str, Any]) -> Array:
        """Joint positions (n,) [rad] of `values` [deg], which may name other servos too; NaN for a missing one."""
        degrees = [_number(values.get(key)) for key in self.keys]
        return np.radians(self.signs * (np.array(degrees) - self.offsets))

    def values(self, q: Array) -> dict[str, float]:
        """The values [deg] of the servos at the joint positions `q` (n,) [rad]."""
        degrees = self.signs * np.degrees(q) + self.offsets
        return {key: float(value) for key, value in zip(self.keys, degrees, strict=True)}

    def find_range_problem(self, q: Array) -> str:
        """Why the joint positions `q` (n,) [rad] contradict the ranges of the robot model; "" if they do not."""
        for joint, key, value in zip(self.robot_model.joints, self.keys, q, strict=True):
            low, high = joint.lower.value, joint.upper.value
            if not isfinite(value):
                return f"The reading has no finite number for {key}"
            if not low - RANGE_TOLERANCE <= value <= high + RANGE_TOLERANCE:
                allowed = f"{np.degrees(low):.0f}° to {np.degrees(high):.0f}°"
                return f"{key} reads {np.degrees(value):.1f}° after calibration; {joint.name} has the range {allowed}"
        return ""


def _number(value: object) -> float:
    return float(value) if _is_finite(value) else float("nan")  # type: ignore[arg-type]


def _is_finite(value: object) -> bool:
    """Whether `value` is a finite number, also of numpy or of a tensor library, but no truth value and no text."""
    if isinstance(value, (bool, np.bool_, str, bytes)):
        return False
    try:
        return isfinite(value)  # type: ignore[arg-type]
    except (TypeError, ValueError, OverflowError):
        return False


def _listed(names: Sequence[object]) -> str:
    shown = ", ".join(str(name)[:40] for name in names[:MAX_SHOWN_NAMES])
    return f"{shown} and {len(names) - MAX_SHOWN_NAMES} more" if len(names) > MAX_SHOWN_NAMES else shown
