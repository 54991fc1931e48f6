"""Fixtures of the command line's tests."""

import pytest

from tests.support.completed_run import completed_run as finished_run


@pytest.fixture(scope="session")
def completed_run(tmp_path_factory):
    return finished_run(tmp_path_factory)


@pytest.fixture
def run_command(tmp_path, monkeypatch, capsys):
    """Run a command in an empty folder; returns (exit code, stdout, stderr)."""
    from dualbrain.cli.main import run_command_line  # noqa: PLC0415

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path))

    def run(*arguments):
        code = run_command_line([str(part) for part in arguments])
        out, err = capsys.readouterr()
        return code, out, err

    return run
