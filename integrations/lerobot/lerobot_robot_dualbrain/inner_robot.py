"""The guarded robot as a bus: its units, fast readings of its joints, and one writer."""

import threading
from collections.abc import Callable, Mapping
from functools import wraps
from typing import Any

from lerobot.robots import Robot

from dualbrain.errors import ConfigurationError
from dualbrain.safety.integration.servo_bus.bus_thread import BusThread

DEGREES = "degrees"
CLIP_TOLERANCE = 0.01
"""Difference [deg] between a command and what the robot says it sent, above which the robot has clipped it."""
CAMERA_READS = ("read", "async_read", "read_latest")
"""Methods of LeRobot's cameras that may wait for a frame."""
SECOND_WRITER = (
    "Another part of the program writes to the guarded robot; the arm comes to rest. Remedy: send every action through "
    "the robot `dualbrain_guarded`"
)


def check_configuration(inner: Robot, keys: tuple[str, ...], units: str) -> None:
    """Refuse a robot whose units are not degrees, or that clips commands itself; `keys` are those of the joints.

    Raises:
        ConfigurationError: the message states the option to change.
    """
    found = _units(inner, keys) or units
    if found != DEGREES:
        known = f"takes {found}" if found else "does not report its units"
        fix = (
            "Set `use_degrees: true` in `--robot.inner`, and record or train in degrees."
            if found
            else "If its joints are in degrees, set `--robot.units=degrees`."
        )
        raise ConfigurationError.stating(f"The robot {inner.name} {known}; the guard needs degrees.", fix=fix)
    if getattr(inner.config, "max_relative_target", None) is not None:
        raise ConfigurationError.stating(
            f"The robot {inner.name} clips commands itself (max_relative_target): the safe command would not reach the "
            "servos.",
            fix="Leave `max_relative_target` out of `--robot.inner`; the guard limits speed and acceleration.",
        )


def _units(inner: Robot, keys: tuple[str, ...]) -> str:
    """The units of the joints: of its motors if it has a bus, else by its option `use_degrees`; "" if unknown."""
    motors = getattr(getattr(inner, "bus", None), "motors", None)
    if isinstance(motors, dict):
        modes = {str(getattr(m.norm_mode, "value", m.norm_mode)) for name, m in motors.items() if f"{name}.pos" in keys}
        return " and ".join(sorted(modes))
    use_degrees = getattr(inner.config, "use_degrees", None)
    return "" if use_degrees is None else DEGREES if use_degrees else "range_m100_100"


class InnerRobot:
    """Access to the guarded robot, one call at a time; only the bus thread may write.

    While an observation waits for a frame of a camera, the bus thread continues: a camera is not on the servo bus.
    """

    def __init__(self, inner: Robot) -> None:
        """Access `inner`."""
        self.robot = inner
        self._lock = threading.RLock()
        self._released_cameras: list[Any] = []
        self._observing = threading.local()

    def allow_only(self, bus: BusThread) -> None:
        """Let `send_action` of the guarded robot refuse every other caller than the thread of `bus`."""
        send: Callable[[dict[str, Any]], Mapping[str, Any]] = self.robot.send_action

        def send_from_the_bus(action: dict[str, Any]) -> Mapping[str, Any]:
            if not bus.is_current:
                bus.refuse(SECOND_WRITER)
                raise ConfigurationError.stating(f"{SECOND_WRITER}.")
            return send(action)

        self.robot.send_action = send_from_the_bus  # type: ignore[method-assign]

    def observation(self) -> dict[str, Any]:
        """The observation of the guarded robot."""
        with self._lock:
            self._release_for_cameras()
            self._observing.holds_lock = True
            try:
                return dict(self.robot.get_observation())
            finally:
                self._observing.holds_lock = False

    def _release_for_cameras(self) -> None:
        """Let the present cameras release the lock while `observation` reads them."""
        for camera in getattr(self.robot, "cameras", {}).values():
            if any(camera is one for one in self._released_cameras):
                continue
            self._released_cameras.append(camera)
            for name in CAMERA_READS:
                if callable(read := getattr(camera, name, None)):
                    setattr(camera, name, self._without_lock(read))

    def _without_lock(self, read: Callable[..., Any]) -> Callable[..., Any]:
        """`read` that releases the lock meanwhile if the calling thread holds it in `observation`."""

        @wraps(read)
        def read_without_lock(*arguments: Any, **options: Any) -> Any:
            if not getattr(self._observing, "holds_lock", False):
                return read(*arguments, **options)
            self._observing.holds_lock = False  # a read may call another one
            self._lock.release()
            try:
                return read(*arguments, **options)
            finally:
                self._lock.acquire()
                self._observing.holds_lock = True

        return read_without_lock

    def positions(self) -> Mapping[str, Any]:
        """The positions of the servos, without camera images if the robot has a bus."""
        found = self._from_bus("Present_Position")
        return self.observation() if found is None else found

    def commanded(self) -> Mapping[str, Any] | None:
        """The positions that the servos hold, None if the robot does not report them."""
        try:
            return self._from_bus("Goal_Position")
        except Exception:  # not every bus has this register
            return None

    def write(self, values: Mapping[str, float]) -> None:
        """Send `values`; raises `ConfigurationError` if the robot sends others."""
        with self._lock:
            sent = self.robot.send_action(dict(values))
        for key, value in values.items():
            if key in sent and abs(float(sent[key]) - float(value)) > CLIP_TOLERANCE:
                raise ConfigurationError.stating(
                    f"{self.robot.name} has sent {float(sent[key]):.2f} instead of {float(value):.2f} to {key}",
                    fix="Turn its own limits off.",
                )

    def _from_bus(self, register: str) -> dict[str, Any] | None:
        bus = getattr(self.robot, "bus", None)
        if bus is None or not hasattr(bus, "sync_read"):
            return None
        retries = getattr(self.robot.config, "num_read_retries", 0)
        with self._lock:
            return {f"{name}.pos": value for name, value in bus.sync_read(register, num_retry=retries).items()}
