"""Worker pools: a failed, dead or hung worker costs its unit only, and no worker outlives its parent."""

import json
import os
import signal
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path

import pytest

from dualbrain.core.storage.jsonl_log import JsonlLog
from dualbrain.evaluation.runner.worker_pool import ProcessPool, SerialPool
from tests.support.process_state import process_state

ROOT = Path(__file__).resolve().parents[3]
PARENT_SCRIPT = """
import sys
from pathlib import Path
sys.path.insert(0, {root!r})
from dualbrain.core.storage.jsonl_log import JsonlLog
from dualbrain.evaluation.runner.worker_pool import ProcessPool
from tests.evaluation.runner.test_worker_pool import SampleUnit, make_doubler
if __name__ == "__main__":
    units = [SampleUnit(str(n), {{"n": n, "pause_s": 0.2, "hang": {hang}}}) for n in range(1, 100)]
    for report in ProcessPool(make_doubler, 1).run_units(units):
        if report.line is not None:
            JsonlLog(Path({path!r})).append(report.line)
"""


@dataclass(frozen=True)
class SampleUnit:
    key: str
    parameters: dict = field(default_factory=dict)


def double(unit):
    """Doubles a number, or fails, dies or hangs."""
    if unit.parameters.get("die"):
        os._exit(9)
    if "die_after_s" in unit.parameters:
        threading.Timer(unit.parameters["die_after_s"], os._exit, [9]).start()
    time.sleep(unit.parameters.get("pause_s", 0.0))
    n = unit.parameters["n"]
    yield {"key": unit.key, "double": n + n, "worker": os.getpid(), "nice": os.nice(0)}
    if unit.parameters.get("hang"):
        time.sleep(3600.0)
    yield {"key": unit.key, "inverse": 1 / n}


def make_doubler():
    """Called in a worker."""
    return double


def ended(reports):
    """By key, the report that ended the unit."""
    return {report.unit.key: report for report in reports if report.line is None}


@pytest.mark.parametrize("jobs", [1, 2])
def test_every_unit_is_done_once_and_a_failed_or_dead_one_costs_only_itself(jobs):
    units = [
        SampleUnit("zero", {"n": 0}),
        SampleUnit("dead", {"n": 1, "die": True}),
        *(SampleUnit(str(n), {"n": n}) for n in range(1, 6)),
    ]
    reports = list(ProcessPool(make_doubler, jobs).run_units(units))
    ends = ended(reports)
    assert sorted(report.unit.key for report in reports if report.line is None) == sorted(unit.key for unit in units)
    lines = {key: [report.line for report in reports if report.line and report.unit.key == key] for key in ends}
    assert [lines[str(n)][0]["double"] for n in range(1, 6)] == [2, 4, 6, 8, 10]
    assert [lines[str(n)][1]["inverse"] for n in range(1, 6)] == [1 / n for n in range(1, 6)]
    assert not any(ends[str(n)].error for n in range(1, 6))
    assert ends["zero"].error == "ZeroDivisionError: division by zero"
    assert "in double" in ends["zero"].traceback
    assert ends["dead"].error == "the worker died with exit code 9"
    assert len(lines["zero"]) == 1
    assert not lines["dead"]


def test_a_serial_pool_reports_the_same():
    units = [SampleUnit("zero", {"n": 0}), SampleUnit("one", {"n": 1})]
    reports = list(SerialPool(double).run_units(units))
    assert [(report.unit.key, report.error) for report in reports if report.line is None] == [
        ("zero", "ZeroDivisionError: division by zero"),
        ("one", ""),
    ]
    assert [report.line.get("double") for report in reports if report.line] == [0, 2, None]


def test_without_units_no_process_is_started():
    assert list(ProcessPool(partial(pytest.fail, "started"), 2).run_units([])) == []


def test_workers_run_at_the_given_niceness():
    (line,) = [
        report.line
        for report in ProcessPool(make_doubler, 1, niceness=7).run_units([SampleUnit("one", {"n": 1})])
        if report.line and "nice" in report.line
    ]
    assert line["nice"] == min(19, os.nice(0) + 7)


def test_a_worker_that_hangs_is_killed_and_its_lines_count():
    """On a clock on which an hour passes while the worker hangs, and no time while workers start."""
    passed_s = 0.0
    reports = []
    pool = ProcessPool(make_doubler, 1, clock=lambda: passed_s)
    for report in pool.run_units([SampleUnit("hangs", {"n": 1, "hang": True}), SampleUnit("next", {"n": 2})]):
        reports.append(report)
        if report.unit.key == "hangs" and report.line:
            passed_s = 3600.0
    assert ended(reports)["hangs"].error == (
        "the worker died with exit code -9, killed after it had reported nothing for 3600 s"
    )
    assert not ended(reports)["next"].error
    assert [report.line["double"] for report in reports if report.line and "double" in report.line] == [2, 4]


def test_a_worker_that_dies_between_two_units_is_replaced():
    """It is killed after it has reported the end of its unit, while its parent is busy with a line of it."""
    units = [SampleUnit("1", {"n": 1, "die_after_s": 0.1}), SampleUnit("2", {"n": 2}), SampleUnit("3", {"n": 3})]
    reports = []
    for report in ProcessPool(make_doubler, 1).run_units(units):
        reports.append(report)
        if report.line and "worker" in report.line and report.unit.key == "1":
            wait_until(lambda worker=report.line["worker"]: not process_state(worker))
            time.sleep(0.2)  # its other threads end after the first one, and its pipe closes with the last
    assert {key: report.error for key, report in ended(reports).items()} == {"1": "", "2": "", "3": ""}


@pytest.mark.parametrize(("hang", "number"), [(False, signal.SIGKILL), (True, signal.SIGKILL), (True, signal.SIGTERM)])
def test_a_killed_parent_keeps_its_log_and_its_worker_ends(tmp_path, hang, number):
    """Also in the middle of a unit."""
    log = JsonlLog(tmp_path / "a.jsonl")
    script = tmp_path / "parent.py"
    script.write_text(PARENT_SCRIPT.format(root=str(ROOT), path=str(log.path), hang=hang))
    parent = subprocess.Popen([sys.executable, str(script)])
    wait_until(lambda: len(log.latest()) >= (1 if hang else 2))
    parent.send_signal(number)
    parent.wait()
    keys = [line["key"] for line in log.latest()]
    assert keys == [str(n) for n in range(1, len(keys) + 1)]
    worker = json.loads(log.path.read_text().splitlines()[0])["worker"]
    wait_until(lambda: not process_state(worker))


def wait_until(condition, timeout_s=20.0):
    end = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.05)
