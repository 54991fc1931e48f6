"""The engine: units are run once, failed ones are run again, and a packed log continues in another checkout."""

import sys

import pytest

from dualbrain.core.storage.jsonl_log import JsonlLog
from experiments import __main__ as command
from experiments.engine.experiment import group_of
from tests.experiments.engine.reciprocals import Reciprocals


@pytest.fixture
def run(tmp_path, monkeypatch):
    experiment = Reciprocals()
    monkeypatch.setattr(command, "EXPERIMENTS", {experiment.name: experiment})
    monkeypatch.setattr(command, "LOGS", tmp_path / "logs")

    def run(*options, folder="runs"):
        arguments = ["-", experiment.name, "--jobs", "1", "--nice", "0", "--folder", str(tmp_path / folder), *options]
        monkeypatch.setattr(sys, "argv", arguments)
        return command.main()

    return run


def test_failed_units_are_reported_and_run_again(run, tmp_path, capsys):
    assert run() == 1
    first = capsys.readouterr()
    assert "2 defined" in first.out
    assert "failed: 0: ZeroDivisionError: division by zero" in first.out
    assert "reciprocals 1/3" in first.err
    assert run() == 1
    assert [line for line in capsys.readouterr().err.splitlines() if "| 0 |" not in line] == []
    rows = JsonlLog(tmp_path / "runs" / "reciprocals.jsonl").latest()
    assert [row["key"] for row in rows] == ["2", "1", "0"]
    for row in rows:
        assert {"revision", "machine", "date"} <= row.keys()
    assert {"wall_s", "load", "value"} <= rows[0].keys()
    assert "ZeroDivisionError" in rows[2]["traceback"]


def test_another_checkout_continues_from_the_committed_log(run, tmp_path, capsys):
    run("--limit", "1", "--keep")
    assert (tmp_path / "logs" / group_of(Reciprocals()) / "reciprocals.jsonl.xz").exists()
    capsys.readouterr()
    assert run("--tables", folder="elsewhere") == 0
    assert "1 defined" in capsys.readouterr().out
    run("--limit", "2", folder="elsewhere")
    assert [row["key"] for row in JsonlLog(tmp_path / "elsewhere" / "reciprocals.jsonl").latest()] == ["2", "1"]


def test_a_fresh_start_renames_the_earlier_log(run, tmp_path):
    run("--limit", "1", "--keep")
    run("--limit", "2", "--fresh")
    assert len(list((tmp_path / "runs").glob("reciprocals.*T*.jsonl"))) == 1
    lines = JsonlLog(tmp_path / "runs" / "reciprocals.jsonl").read()
    assert [line["key"] for line in lines] == ["2", "1"]


def test_without_a_log_there_is_no_table(run, capsys):
    assert run("--tables") == 0
    assert "No unit is finished." in capsys.readouterr().out
