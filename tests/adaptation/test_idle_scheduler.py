"""Learning gives way: to a robot at work, a busy machine, a battery; at once, and without losing what it learnt."""

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest

from dualbrain.adaptation.idle_scheduler import (
    IdleScheduler,
    IdleSchedulerConfig,
    MachineLoad,
    blocking_reason,
    read_machine_load,
    robot_activity,
)
from dualbrain.memory.ledger.writer_lock import LockHolder, WriterLock, current_holder

QUIET = MachineLoad(0.2, 2, on_battery=False)
COUNTING = "import sys, time\nwhile True:\n    open(sys.argv[1], 'a').write('.')\n    time.sleep(0.01)\n"


def test_each_thing_that_speaks_against_it_is_named():
    assert blocking_reason(QUIET, "") == ""
    assert blocking_reason(QUIET, "dualbrain run a (process 7)") == "dualbrain run a (process 7)"
    assert "battery" in blocking_reason(MachineLoad(0.0, 2, on_battery=True), "")
    assert "busy" in blocking_reason(MachineLoad(1.2, 2, on_battery=False), "")
    busy = MachineLoad(3.0, 2, on_battery=False)
    assert blocking_reason(busy, "", own_threads=2) == ""  # two of the load are its own
    assert "busy" in blocking_reason(busy, "", own_threads=1)


def test_the_machine_is_seen_and_its_batteries(tmp_path):
    assert read_machine_load(tmp_path / "none").on_battery is False
    for name, status in (("BAT0", "Discharging"), ("AC", "Unknown")):
        (tmp_path / name).mkdir()
        (tmp_path / name / "status").write_text(f"{status}\n")
    assert read_machine_load(tmp_path).on_battery
    (tmp_path / "BAT0" / "status").write_text("Charging\n")
    assert not read_machine_load(tmp_path).on_battery


def test_a_session_counts_as_work_from_its_ledger_s_lock_to_its_release(tmp_path):
    ledger = tmp_path / "ledger.sqlite"
    assert robot_activity(ledger, ()) == ""
    lock = WriterLock(ledger, LockHolder(os.getpid(), "dualbrain run r-1", 1.0))
    assert robot_activity(ledger, ()) == f"dualbrain run r-1 (process {os.getpid()})"
    assert robot_activity(ledger, (), own_pid=os.getpid()) == ""
    assert current_holder(ledger) is not None  # being looked at takes nothing away
    lock.release()
    assert robot_activity(ledger, ()) == ""


def test_a_session_that_was_killed_does_not_count(tmp_path):
    ledger = tmp_path / "ledger.sqlite"
    gone = subprocess.Popen([sys.executable, "-S", "-c", ""])
    gone.wait()
    lock = WriterLock(ledger, LockHolder(gone.pid, "dualbrain run r-2", 1.0))
    assert robot_activity(ledger, ()) == ""
    lock.release()


def test_a_gatekeeper_counts_while_it_listens(tmp_path):
    path = tmp_path / "gatekeeper.sock"
    path.touch()
    assert robot_activity(tmp_path / "l", (path,)) == ""  # a file that a killed one left
    path.unlink()
    with socket.socket(socket.AF_UNIX) as listening:
        listening.bind(str(path))
        listening.listen()
        assert "a gatekeeper at" in robot_activity(tmp_path / "l", (path,))


class Stage:
    """A child that counts, and reasons that come and go with the looks."""

    def __init__(self, folder: Path, reasons, script=COUNTING, pace=None):
        self.folder, self.reasons, self.script, self.now = folder, list(reasons), script, 0.0
        self.started, self.told, self.watched = 0, [], []
        pace = pace or IdleSchedulerConfig(poll_period=0.1, quiet_time=0.3, max_halted_time=100.0)
        self.work = IdleScheduler(
            self.start, self.why_not, self.told.append, clock=lambda: self.now, sleep=self.sleep, config=pace
        )

    @property
    def counted(self):
        path = self.folder / "count"
        return path.stat().st_size if path.exists() else 0

    def start(self):
        self.started += 1
        command = [sys.executable, "-S", "-c", self.script, str(self.folder / "count")]
        return subprocess.Popen(command, start_new_session=True)

    def why_not(self, own):
        if not self.reasons:
            raise KeyboardInterrupt  # the end of the story
        return self.reasons.pop(0)

    def sleep(self, seconds):
        self.now += seconds
        time.sleep(0.05)
        child = self.work._child
        self.watched.append((self.counted, child.pid if child else None))

    def run(self):
        with pytest.raises(KeyboardInterrupt):
            self.work.run()


def stands(path):
    """Whether a process is halted or gone."""
    try:
        return Path(f"/proc/{path}/stat").read_text().rsplit(")", 1)[1].split()[0] in "TZ"
    except OSError:
        return True


def test_it_begins_when_quiet_stands_still_at_once_and_goes_on(tmp_path):
    story = ["busy"] * 3 + [""] * 14 + ["robot"] * 8 + [""] * 12
    stage = Stage(tmp_path, story)
    stage.run()
    counts = [count for count, _ in stage.watched]
    assert counts[5] == 0  # three busy looks, then calm for three more
    halted = counts[18:25]  # one look after the robot began
    assert len(set(halted)) == 1
    assert halted[0] > 0
    assert counts[-1] > halted[0]
    assert (stage.started, stage.told) == (1, ["waiting: busy", "learning", "halted: robot", "learning"])
    assert stands(stage.watched[-1][1])  # an interruption ends it


def test_what_is_halted_for_long_is_put_away_and_begun_again(tmp_path):
    stage = Stage(
        tmp_path,
        [""] * 8 + ["robot"] * 10 + [""] * 10,
        pace=IdleSchedulerConfig(poll_period=0.1, quiet_time=0.3, max_halted_time=0.5),
    )
    stage.run()
    assert stage.started == 2
    assert stage.told[2].startswith("put away")
    assert stage.watched[16][1] is None
    assert stage.told[-1] == "learning"


def test_it_ends_with_the_code_of_the_work(tmp_path):
    stage = Stage(tmp_path, [""] * 200, script="import sys; sys.exit(3)")
    assert stage.work.run() == 3


def test_a_child_that_dies_by_itself_while_halted_is_no_trouble(tmp_path):
    stage = Stage(tmp_path, [])

    def why_not(own):
        if own is not None and len(stage.told) == 1:
            os.kill(own, signal.SIGKILL)
            return "robot"
        return ""

    stage.work._get_blocking_reason = why_not
    assert stage.work.run() == -signal.SIGKILL
