import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from experiments.engine.experiment import WorkUnit
from experiments.engine.jsonl_log import JsonlLog
from experiments.engine.worker_pool import run_units

CATALOGUE = "tests.experiments.engine.sample_experiments"
ROOT = Path(__file__).resolve().parents[3]
SLOW = """
import sys
from pathlib import Path
sys.path.insert(0, {root!r})
from experiments.engine.worker_pool import carry_out
from experiments.engine.jsonl_log import Journal
from experiments.engine.experiment import Unit
if __name__ == "__main__":
    units = [Unit(str(n), {{"n": n, "nap": 0.2}}) for n in range(1, 100)]
    for row in carry_out("doubling", units, 1, 0, "{catalogue}"):
        Journal(Path({path!r})).append(row)
"""


@pytest.mark.parametrize("jobs", [1, 2])
def test_every_unit_is_done_once_and_what_breaks_or_dies_costs_only_itself(jobs):
    units = [
        WorkUnit("zero", {"n": 0}),
        WorkUnit("dead", {"n": 1, "die": True}),
        *(WorkUnit(str(n), {"n": n}) for n in range(1, 6)),
    ]
    rows = list(run_units("doubling", units, jobs, 0, CATALOGUE))
    done = {row["key"]: row for row in rows}
    assert sorted(row["key"] for row in rows) == sorted(unit.key for unit in units)
    assert {done[str(n)]["double"] for n in range(1, 6)} == {2, 4, 6, 8, 10}
    assert done["zero"]["error"].startswith("ZeroDivisionError")
    assert done["dead"] == {"key": "dead", "error": "the worker died with exit code 9"}
    assert all(row["wall_s"] >= 0.0 for key, row in done.items() if key != "dead")


def test_nothing_to_do_starts_nobody():
    assert list(run_units("doubling", [], 2, 0, CATALOGUE)) == []


def test_a_killed_parent_keeps_what_was_done_and_its_worker_ends(tmp_path):
    journal = JsonlLog(tmp_path / "a.jsonl")
    script = tmp_path / "slow.py"
    script.write_text(SLOW.format(root=str(ROOT), catalogue=CATALOGUE, path=str(journal.path)))
    parent = subprocess.Popen([sys.executable, str(script)])
    wait_until(lambda: len(journal.rows()) >= 2)
    parent.send_signal(signal.SIGKILL)
    parent.wait()
    rows = journal.rows()
    assert [row["key"] for row in rows] == [str(n) for n in range(1, len(rows) + 1)]
    worker = json.loads(journal.path.read_text().splitlines()[0])["worker"]
    wait_until(lambda: not alive(worker))


def wait_until(happened, timeout_s=20.0):
    end = time.monotonic() + timeout_s
    while not happened():
        assert time.monotonic() < end
        time.sleep(0.05)


def alive(pid):
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return "Z" not in Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2][:3]
