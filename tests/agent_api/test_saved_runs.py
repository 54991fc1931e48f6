"""Reports of the runs of an agent: a failure to write one is reported, and changes nothing else."""

import errno
import os

import pytest

from dualbrain.agent_api import saved_runs
from dualbrain.agent_api.saved_runs import SavedRuns
from dualbrain.robots.loader import load_robot
from dualbrain.visualization.html import run_report
from tests.memory.memory_samples import episode


def not_a_file(folder, monkeypatch):
    (folder / "r-1" / "report.html").mkdir()


def mistake_in_the_report(folder, monkeypatch):
    monkeypatch.setattr(run_report, "render_report", lambda *parts: {}["missing"])


@pytest.mark.parametrize(("failure", "reason"), [(not_a_file, "was not written"), (mistake_in_the_report, "KeyError")])
def test_a_failed_report_is_returned_and_logged_and_the_episode_stays(failure, reason, tmp_path, monkeypatch, caplog):
    saved = SavedRuns(tmp_path, load_robot("panda"))
    saved.save_episode(episode("r-1"))
    failure(tmp_path, monkeypatch)
    problem = saved.save_report(episode("r-1"), [])
    assert problem.startswith("No report of the run r-1: ")
    assert reason in problem
    assert [(one.levelname, one.message) for one in caplog.records] == [("WARNING", problem)]
    assert (tmp_path / "r-1" / "episode.json").is_file()


def test_an_episode_that_cannot_be_saved_is_a_problem_and_is_logged(tmp_path, monkeypatch, caplog):
    saved = SavedRuns(tmp_path, load_robot("panda"))
    with monkeypatch.context() as patch:
        patch.setattr(saved_runs, "write_atomically", full_disk)
        saved.save_episode(episode("r-1"))
    assert saved.problem.startswith("The run r-1 is not saved: ")
    assert "No space left on device" in saved.problem
    assert [(one.levelname, one.message) for one in caplog.records] == [("WARNING", saved.problem)]
    saved.save_episode(episode("r-2"))
    assert not saved.problem
    assert (tmp_path / "r-2" / "episode.json").is_file()


def full_disk(path, data):
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), str(path))
