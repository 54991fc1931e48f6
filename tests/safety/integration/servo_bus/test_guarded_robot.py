"""The guarded robot of LeRobot, with a stand-in for the few names of LeRobot that it uses."""

import importlib
import sys
import threading
import time
from contextlib import contextmanager
from pathlib import Path
from types import ModuleType, SimpleNamespace

import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.safety.integration.servo_bus.servo_settings import ServoSettings
from tests.safety.integration.servo_bus.ideal_servos import KEYS, IdealServos

PACKAGE = "lerobot_robot_dualbrain"
FOLDER = Path(__file__).resolve().parents[4] / "integrations" / "lerobot" / PACKAGE


class Robot:
    """The base class of robots, as far as the guarded robot uses it."""

    def __init__(self, config):
        self.config = config


class Servos:
    """An inner robot on ideal servos; a reading raises `failure`, if there is one."""

    name = "servos"

    def __init__(self):
        self.config = SimpleNamespace()
        self.ideal, self.failure, self.stuck = IdealServos(), None, False
        self.is_connected, self.is_calibrated = False, True
        self.action_features = self.observation_features = dict.fromkeys(KEYS, float)

    def connect(self, calibrate=True):
        self.is_connected = True

    def disconnect(self):
        if self.stuck:
            raise ConnectionError("the port is gone")
        self.is_connected = False

    def get_observation(self):
        if self.failure is not None:
            raise self.failure
        return self.ideal.read()

    def send_action(self, action):
        self.ideal.write(action)
        return action


class SerialBus:
    """A bus that answers one call at a time."""

    def __init__(self, ideal):
        self._ideal, self._free = ideal, threading.Lock()

    def sync_read(self, register, num_retry=0):
        with self.exclusively():
            values = (
                self._ideal.read() if register == "Present_Position" else dict(zip(KEYS, self._ideal.goal, strict=True))
            )
        return {key.removesuffix(".pos"): value for key, value in values.items()}

    @contextmanager
    def exclusively(self):
        if not self._free.acquire(blocking=False):
            raise ConnectionError("Port is in use!")
        try:
            yield
        finally:
            self._free.release()


class Camera:
    """A camera whose frame comes after `wait`."""

    def __init__(self, wait):
        self._wait = wait

    def read(self):
        return self.async_read()

    def async_read(self, timeout_ms=200.0):
        self._wait()
        return "frame"


class ServosWithCamera(Servos):
    """An inner robot as LeRobot builds it: joints on a serial bus, and a camera."""

    def __init__(self, wait):
        super().__init__()
        self.bus, self.cameras = SerialBus(self.ideal), {"front": Camera(wait)}

    def get_observation(self):
        values = self.bus.sync_read("Present_Position")
        return {**{f"{name}.pos": value for name, value in values.items()}, "front": self.cameras["front"].read()}

    def send_action(self, action):
        with self.bus.exclusively():
            return super().send_action(action)


@pytest.fixture
def guard(monkeypatch):
    """A function that guards an inner robot."""
    names = {
        "lerobot.robots": {"Robot": Robot},
        "lerobot.robots.utils": {"make_robot_from_config": None},
        f"{PACKAGE}.config_dualbrain_guarded": {"DualbrainGuardedConfig": object},
    }
    for name in ("lerobot", PACKAGE, *names):
        module = ModuleType(name)
        module.__dict__.update(names.get(name, {}))
        module.__path__ = [str(FOLDER)] if name == PACKAGE else []
        monkeypatch.setitem(sys.modules, name, module)
    for name in ("inner_robot", "dualbrain_guarded"):
        monkeypatch.delitem(sys.modules, f"{PACKAGE}.{name}", raising=False)
    guarded = importlib.import_module(f"{PACKAGE}.dualbrain_guarded").DualbrainGuarded
    config = SimpleNamespace(settings=ServoSettings(model="so101"), units="degrees", mark_interventions=False)
    yield lambda inner: guarded(config, inner)
    for name in ("inner_robot", "dualbrain_guarded"):
        sys.modules.pop(f"{PACKAGE}.{name}", None)


def test_a_robot_that_connects_is_disconnected_with_its_thread(guard):
    robot = guard(Servos())
    robot.connect()
    assert (robot.is_connected, robot.bus.is_running) == (True, True)
    robot.disconnect()
    assert (robot.is_connected, robot.bus.is_running) == (False, False)


@pytest.mark.parametrize("failure", [ConnectionError("no status packet"), KeyboardInterrupt()], ids=["bus", "Ctrl-C"])
def test_an_inner_robot_that_cannot_be_read_is_disconnected(failure, guard):
    inner = Servos()
    inner.failure = failure
    robot = guard(inner)
    with pytest.raises(type(failure)):
        robot.connect()
    assert (inner.is_connected, robot.bus.is_running) == (False, False)


def test_an_inner_robot_whose_thread_does_not_start_is_disconnected(guard, monkeypatch):
    inner = Servos()
    robot = guard(inner)

    def refuse(thread):
        raise RuntimeError("can't start new thread")

    with monkeypatch.context() as patched:
        patched.setattr(threading.Thread, "start", refuse)
        with pytest.raises(RuntimeError, match="new thread"):
            robot.connect()
    assert not inner.is_connected
    robot.connect()
    assert robot.bus.is_running
    robot.disconnect()


def test_an_inner_robot_that_stays_connected_is_stated_with_the_first_error(guard):
    inner = Servos()
    inner.failure, inner.stuck = ConfigurationError.stating("A first problem.", fix="Repair it."), True
    with pytest.raises(ConfigurationError, match="A first problem") as found:
        guard(inner).connect()
    assert "servos was not disconnected: the port is gone" in found.value.__notes__[0]


def test_the_bus_thread_continues_while_an_observation_waits_for_a_camera(guard):
    def wait():
        target, deadline = robot.bus.timing.periods + 5, time.monotonic() + 5.0
        while robot.bus.timing.periods < target:
            assert time.monotonic() < deadline
            time.sleep(0.001)

    robot = guard(ServosWithCamera(wait))
    robot.connect()
    try:
        for _ in range(10):
            found = robot.get_observation()
            robot.send_action({key: found[key] for key in KEYS})
            assert not robot.state.problem
    finally:
        robot.disconnect()
    assert found["front"] == "frame"


@pytest.mark.parametrize("name", ["calibrate", "configure"])
def test_no_servo_is_calibrated_or_configured_beside_the_thread(guard, name):
    """Both may switch the torque off."""
    inner, calls = Servos(), []
    setattr(inner, name, lambda: calls.append(name))
    robot = guard(inner)
    getattr(robot, name)()
    robot.connect()
    with pytest.raises(ConfigurationError, match="Disconnect before"):
        getattr(robot, name)()
    robot.disconnect()
    assert calls == [name]
