"""Fixtures of the command line's tests."""

import pytest

from tests.support.completed_run import finished as finished_run


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    return finished_run(tmp_path_factory)


@pytest.fixture
def tell(tmp_path, monkeypatch, capsys):
    """Run a command in an empty folder; returns (exit code, stdout, stderr)."""
    from dualbrain.cli.main import call  # noqa: PLC0415

    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path))

    def run(*arguments):
        code = call([str(part) for part in arguments])
        out, err = capsys.readouterr()
        return code, out, err

    return run
