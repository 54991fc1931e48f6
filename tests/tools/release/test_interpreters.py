"""The release check finds interpreters that run, and names a missing version with the ways to get it."""

import sys

import pytest

from tools.release.__main__ import main
from tools.release.interpreters import MissingInterpreterError, find_interpreter, find_interpreters


@pytest.fixture
def empty_machine(tmp_path, monkeypatch):
    """A machine without interpreters; returns the folders of PATH, pyenv and uv."""
    folders = {name: tmp_path / name for name in ("PATH", "PYENV_ROOT", "XDG_DATA_HOME")}
    for name, folder in folders.items():
        folder.mkdir()
        monkeypatch.setenv(name, str(folder))
    return folders


def write_program(path, text):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f"#!/bin/sh\n{text}\n")
    path.chmod(0o755)


@pytest.mark.parametrize(
    ("variable", "place"),
    [
        ("PATH", "python9.1"),
        ("PYENV_ROOT", "versions/9.1.4/bin/python3"),
        ("XDG_DATA_HOME", "uv/python/cpython-9.1.4-linux/bin/python3"),
    ],
)
def test_an_interpreter_is_found_on_path_in_pyenv_and_in_uv(empty_machine, variable, place):
    path = empty_machine[variable] / place
    write_program(path, "echo cpython 9.1")
    assert find_interpreter("9.1") == path


def test_a_shim_that_does_not_run_is_no_interpreter(empty_machine):
    write_program(empty_machine["PATH"] / "python9.1", "echo 'python9.1: command not found' >&2; exit 127")
    assert find_interpreter("9.1") is None
    write_program(empty_machine["PATH"] / "python9.1", "echo pypy 9.1")
    assert find_interpreter("9.1") is None
    installed = empty_machine["PYENV_ROOT"] / "versions/9.1.0/bin/python3"
    write_program(installed, "echo cpython 9.1")
    assert find_interpreter("9.1") == installed


def test_missing_versions_are_named_with_the_ways_to_get_them(empty_machine):
    write_program(empty_machine["PATH"] / "python9.1", "echo cpython 9.1")
    with pytest.raises(MissingInterpreterError, match=r"Python 9\.2 was not found.*uv python install 9\.2"):
        find_interpreters(("9.1", "9.2"))
    assert list(find_interpreters(("9.1", "9.2"), allow_missing=True)) == ["9.1"]


@pytest.mark.usefixtures("empty_machine")
def test_the_check_ends_with_2_if_an_interpreter_is_missing(monkeypatch, capsys):
    monkeypatch.setattr(sys, "argv", ["release"])
    assert main() == 2
    assert "--allow-missing" in capsys.readouterr().err
