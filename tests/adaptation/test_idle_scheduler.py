"""Training yields at once to an active robot, a busy machine or battery power, and loses no progress."""

import math
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import pytest

from dualbrain.adaptation.idle_scheduler import (
    LOAD_AVERAGING_TIME,
    IdleScheduler,
    IdleSchedulerConfig,
    MachineLoad,
    blocking_reason,
    read_machine_load,
    remaining_load,
    robot_activity,
)
from dualbrain.memory.ledger.writer_lock import LockHolder, WriterLock, current_holder
from tests.support.process_state import process_state

QUIET = MachineLoad(0.2, 2, on_battery=False)
COUNTING_SCRIPT = "import sys, time\nwhile True:\n    open(sys.argv[1], 'a').write('.')\n    time.sleep(0.01)\n"


def test_each_blocking_reason_is_named():
    assert blocking_reason(QUIET, "") == ""
    assert blocking_reason(QUIET, "dualbrain run a (process 7)") == "dualbrain run a (process 7)"
    assert "battery" in blocking_reason(MachineLoad(0.0, 2, on_battery=True), "")
    assert "busy" in blocking_reason(MachineLoad(1.2, 2, on_battery=False), "")
    busy = MachineLoad(3.0, 2, on_battery=False)
    assert blocking_reason(busy, "", own_load=2) == ""  # the training itself causes a load of two
    assert "busy" in blocking_reason(busy, "", own_load=1)


def test_load_and_batteries_are_read(tmp_path):
    assert read_machine_load(tmp_path / "none").on_battery is False
    for name, status in (("BAT0", "Discharging"), ("AC", "Unknown")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "status").write_text(f"{status}\n")
    assert read_machine_load(tmp_path).on_battery
    (tmp_path / "BAT0" / "status").write_text("Charging\n")
    assert not read_machine_load(tmp_path).on_battery


def test_the_battery_of_a_mouse_or_keyboard_does_not_count(tmp_path):
    mouse = tmp_path / "hidpp_battery_0"
    mouse.mkdir()
    (mouse / "status").write_text("Discharging\n")
    (mouse / "scope").write_text("Device\n")
    assert not read_machine_load(tmp_path).on_battery
    (mouse / "scope").write_text("System\n")
    assert read_machine_load(tmp_path).on_battery


def test_a_power_supply_that_cannot_be_read_is_no_error(tmp_path):
    (tmp_path / "BAT0" / "status").mkdir(parents=True)  # reading it raises an `OSError`, as that of a removed battery
    assert not read_machine_load(tmp_path).on_battery


def test_a_session_is_active_while_it_holds_the_lock_of_its_ledger(tmp_path):
    ledger = tmp_path / "ledger.sqlite"
    assert robot_activity(ledger, ()) == ""
    lock = WriterLock(ledger, LockHolder(os.getpid(), "dualbrain run r-1", 1.0))
    assert robot_activity(ledger, ()) == f"dualbrain run r-1 (process {os.getpid()})"
    assert robot_activity(ledger, (), own_pid=os.getpid()) == ""
    assert current_holder(ledger) is not None  # the check does not release the lock
    lock.release()
    assert robot_activity(ledger, ()) == ""


def test_a_killed_session_is_not_active(tmp_path):
    ledger = tmp_path / "ledger.sqlite"
    gone = subprocess.Popen([sys.executable, "-S", "-c", ""])
    gone.wait()
    lock = WriterLock(ledger, LockHolder(gone.pid, "dualbrain run r-2", 1.0))
    assert robot_activity(ledger, ()) == ""
    lock.release()


@pytest.mark.parametrize("folder", ["home", "my home", "größe"])
def test_a_gatekeeper_is_active_while_it_listens(tmp_path, folder):
    path = tmp_path / folder / "gatekeeper.sock"
    path.parent.mkdir()
    path.touch()
    assert robot_activity(tmp_path / "l", (path,)) == ""  # a file that a killed gatekeeper left
    path.unlink()
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        listening.listen()
        assert "a gatekeeper at" in robot_activity(tmp_path / "l", (path,))


def test_a_gatekeeper_that_runs_is_active_however_its_socket_is_bound(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind("robot.sock")  # `dualbrain gatekeeper --socket robot.sock`
        listening.listen()
        path = tmp_path / "robot.sock"
        assert robot_activity(tmp_path / "l", (), running=(path,)) == f"a gatekeeper at {path}"


class SchedulerBench:
    """A child process that counts, and a list of blocking reasons, one per check."""

    def __init__(self, folder: Path, reasons, script=COUNTING_SCRIPT, pace=None):
        self.folder, self.reasons, self.script, self.now = folder, list(reasons), script, 0.0
        self.started, self.statuses, self.observed = 0, [], []
        pace = pace or IdleSchedulerConfig(poll_period=0.1, quiet_time=0.3, max_halted_time=100.0)
        self.scheduler = IdleScheduler(
            self.start,
            self.get_blocking_reason,
            self.statuses.append,
            clock=lambda: self.now,
            sleep=self.sleep,
            config=pace,
        )

    @property
    def counted(self):
        path = self.folder / "count"
        return path.stat().st_size if path.exists() else 0

    def start(self):
        self.started += 1
        command = [sys.executable, "-S", "-c", self.script, str(self.folder / "count")]
        return subprocess.Popen(command, start_new_session=True)

    def get_blocking_reason(self, own_pid):
        if not self.reasons:
            raise KeyboardInterrupt  # the end of the test
        return self.reasons.pop(0)

    def sleep(self, seconds):
        self.now += seconds
        time.sleep(0.05)
        child = self.scheduler._child
        self.observed.append((self.counted, child.pid if child else None))

    def run(self):
        with pytest.raises(KeyboardInterrupt):
            self.scheduler.run()


def test_training_starts_when_idle_pauses_at_once_and_resumes(tmp_path):
    reasons = ["busy"] * 3 + [""] * 14 + ["robot"] * 8 + [""] * 12
    bench = SchedulerBench(tmp_path, reasons)
    bench.run()
    counts = [count for count, _ in bench.observed]
    assert counts[5] == 0  # three busy checks, then three idle ones before the start
    paused = counts[18:25]  # from one check after the robot became active
    assert len(set(paused)) == 1
    assert paused[0] > 0
    assert counts[-1] > paused[0]
    assert (bench.started, bench.statuses) == (1, ["waiting: busy", "training", "paused: robot", "training"])
    assert process_state(bench.observed[-1][1]) in ("T", "")  # an interruption ends it


def test_a_long_pause_stops_the_training_which_then_starts_again(tmp_path):
    bench = SchedulerBench(
        tmp_path,
        [""] * 8 + ["robot"] * 10 + [""] * 10,
        pace=IdleSchedulerConfig(poll_period=0.1, quiet_time=0.3, max_halted_time=0.5),
    )
    bench.run()
    assert bench.started == 2
    assert bench.statuses[2].startswith("stopped for now")
    assert bench.observed[16][1] is None
    assert bench.statuses[-1] == "training"


class SimulatedLoad(IdleScheduler):
    """A training in two threads on a machine with two processors, which two other processes keep busy from 10 s on."""

    def __init__(self):
        self.now, self.load, self.trained, self.is_running = 0.0, 0.0, 0.0, False
        pace = IdleSchedulerConfig(max_halted_time=math.inf)
        clock, sleep = (lambda: self.now), self.sleep
        super().__init__(self.start, self.reason, lambda status: None, clock=clock, sleep=sleep, config=pace)

    def start(self):
        self.is_running = True
        return SimpleNamespace(pid=1, poll=lambda: None, wait=lambda: None)

    def _signal(self, number):
        self.is_running = number == signal.SIGCONT

    def reason(self, own_pid):
        own_load = remaining_load(2, self.halted_time) if own_pid else 0.0
        return blocking_reason(MachineLoad(self.load, 2, on_battery=False), "", own_load=own_load)

    def sleep(self, seconds):
        present = 2.0 * self.is_running + (2.0 if self.now > 10.0 else 0.0)
        self.load = present + (self.load - present) * math.exp(-seconds / LOAD_AVERAGING_TIME)
        self.trained, self.now = self.trained + seconds * self.is_running, self.now + seconds
        if self.now > 3600.0:
            raise KeyboardInterrupt  # the end of the test


def test_a_paused_training_does_not_hide_the_load_of_other_processes():
    machine = SimulatedLoad()
    with pytest.raises(KeyboardInterrupt):
        machine.run()
    assert 0.0 < machine.trained < 300.0  # it trained 2600 s of this hour when its own load did not decay


def test_the_scheduler_returns_the_exit_code_of_the_work(tmp_path):
    bench = SchedulerBench(tmp_path, [""] * 200, script="import sys; sys.exit(3)")
    assert bench.scheduler.run() == 3


def test_a_child_that_is_killed_while_paused_ends_the_scheduler(tmp_path):
    bench = SchedulerBench(tmp_path, [])

    def get_blocking_reason(own_pid):
        if own_pid is not None and len(bench.statuses) == 1:
            os.kill(own_pid, signal.SIGKILL)
            return "robot"
        return ""

    bench.scheduler._get_blocking_reason = get_blocking_reason
    assert bench.scheduler.run() == -signal.SIGKILL
