"""A spawned gatekeeper ends with its parent, however and whenever the parent ends, and the robot process with it."""

import os
import random
import signal
import subprocess
import sys
import time
from contextlib import contextmanager, suppress
from pathlib import Path

import msgspec
import pytest

from dualbrain.control.gatekeeper.robot_link.simulated_robot import RobotReport

pytestmark = pytest.mark.realtime

SCRIPT = Path(__file__).parent / "parent_process.py"
END_LIMIT = 5.0
"""Longest time [s] from the end of the parent to the end of gatekeeper and robot process."""


def parents():
    """Parent of every running process."""
    found = {}
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            with suppress(OSError):
                fields = (entry / "stat").read_text().rpartition(")")[2].split()
                if fields[0] != "Z":
                    found[int(entry.name)] = int(fields[1])
    return found


def with_descendants(pid):
    found, tree = {pid}, parents()
    while more := {child for child, parent in tree.items() if parent in found} - found:
        found |= more
    return found & tree.keys()


def running(pids):
    return pids & parents().keys()


@contextmanager
def parent(folder):
    """A parent process, and the pid of its gatekeeper."""
    command = [sys.executable, *(["-S"] if sys.flags.no_site else []), str(SCRIPT), str(folder)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True, start_new_session=True) as process:
        group = process.pid
        try:
            yield process, int(process.stdout.readline().split()[1])
        finally:
            with suppress(ProcessLookupError):
                os.killpg(group, signal.SIGKILL)


def robot_of(gatekeeper):
    """The robot process of a gatekeeper."""
    return next(
        pid
        for pid in with_descendants(gatekeeper)
        if b"robot_link" in Path(f"/proc/{pid}/cmdline").read_bytes() and pid != gatekeeper
    )


def seconds_to_end(pids, since):
    while left := running(pids):
        assert time.monotonic() - since < 4 * END_LIMIT, left
        time.sleep(0.02)
    return time.monotonic() - since


def end_parent(folder, number, delay):
    """Time [s] from the end of the parent, `delay` [s] after its contract runs, to the end of its gatekeeper.

    A negative `delay` counts from the start of the gatekeeper.
    """
    folder.mkdir()
    with parent(folder) as (process, gatekeeper):
        if delay >= 0.0:
            assert process.stdout.readline() == "running\n"
        time.sleep(abs(delay))
        family = with_descendants(gatekeeper)
        assert gatekeeper in family
        os.kill(process.pid, number)
        since = time.monotonic()
        process.wait()
        duration = seconds_to_end(family, since)
    if delay >= 0.0:
        report = msgspec.json.decode((folder / "robot.json").read_bytes(), type=RobotReport)
        assert report.drive_off_cause == "order", "the gatekeeper braked the arm; the watchdog of the robot did not"
        assert report.speed < 0.01
        assert report.judgement.violations == ()
    return duration


@pytest.mark.parametrize("number", [signal.SIGKILL, signal.SIGHUP])
@pytest.mark.parametrize("delay", [-0.1, -1.0, 1.5])
def test_gatekeeper_and_robot_end_with_the_parent(tmp_path, number, delay):
    assert end_parent(tmp_path / "run", number, delay) < END_LIMIT


@pytest.mark.slow
def test_gatekeeper_and_robot_end_with_the_parent_at_random_moments(tmp_path, record_property):
    chance = random.Random(1)
    times = []
    for k in range(20):
        number = (signal.SIGKILL, signal.SIGHUP)[k % 2]
        delay = chance.uniform(-3.0, 0.0) if k % 4 < 2 else chance.uniform(0.0, 4.0)
        times.append(end_parent(tmp_path / str(k), number, delay))
    record_property("worst end time [s]", max(times))
    sys.stderr.write(f"end times [s]: worst {max(times):.2f}, median {sorted(times)[10]:.2f}\n")
    assert max(times) < END_LIMIT


def test_the_robot_process_brakes_and_ends_when_the_gatekeeper_is_killed(tmp_path):
    with parent(tmp_path) as (process, gatekeeper):
        assert process.stdout.readline() == "running\n"
        time.sleep(1.0)
        robot = robot_of(gatekeeper)
        os.kill(gatekeeper, signal.SIGKILL)
        since = time.monotonic()
        time.sleep(0.5)
        with suppress(ProcessLookupError):  # it may have ended already
            assert os.sched_getscheduler(robot) == os.SCHED_OTHER
        assert seconds_to_end({robot}, since) < END_LIMIT
    report = msgspec.json.decode((tmp_path / "robot.json").read_bytes(), type=RobotReport)
    assert (report.drive_off_cause, report.speed < 0.01) == ("watchdog", True)


def test_the_robot_process_ends_after_its_gatekeeper_hung_and_was_killed(tmp_path):
    with parent(tmp_path) as (process, gatekeeper):
        assert process.stdout.readline() == "running\n"
        robot = robot_of(gatekeeper)
        os.kill(gatekeeper, signal.SIGSTOP)  # no command arrives, and the link stays open
        time.sleep(0.3)
        assert running({robot}) == {robot}
        os.kill(process.pid, signal.SIGKILL)
        os.kill(gatekeeper, signal.SIGKILL)
        assert seconds_to_end({robot}, time.monotonic()) < END_LIMIT
