"""An unexpected exception is reported with its traceback, and is neither a success nor a task that failed safely."""

import errno
import os
import sys
from importlib.abc import MetaPathFinder

import pytest

from dualbrain.__main__ import run_program
from dualbrain.cli import main
from dualbrain.cli.common.exit_codes import ExitCode


def test_a_defect_is_no_safe_failure(monkeypatch, capsys):
    def broken(*arguments, **options):
        raise ZeroDivisionError("no such thing")

    monkeypatch.setattr(main, "app", broken)
    assert main.run_command_line(["doctor"]) == ExitCode.SETUP
    assert "ZeroDivisionError: no such thing" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("code", "remedy"),
    [(errno.ENOSPC, "Free some space"), (errno.EDQUOT, "quota"), (errno.EROFS, "for writing"), (errno.EIO, "its disk")],
)
@pytest.mark.parametrize("name", ["/data/run/file.json", None])
def test_a_failed_write_is_a_sentence_with_a_remedy(monkeypatch, capsys, code, remedy, name):
    def fail(arguments, **_):
        raise OSError(code, os.strerror(code), name)

    monkeypatch.setattr(main, "app", fail)
    assert main.run_command_line(["doctor"]) == ExitCode.SETUP
    err = capsys.readouterr().err
    assert f"dualbrain: {name or 'A file'} cannot be written: {os.strerror(code)}. " in err
    assert remedy in err


def test_an_interruption_during_the_imports_is_one_line(monkeypatch, capsys):
    class Interrupted(MetaPathFinder):
        def find_spec(self, name, path=None, target=None):
            if name == "dualbrain.cli.main":
                raise KeyboardInterrupt

    monkeypatch.delitem(sys.modules, "dualbrain.cli.main")
    monkeypatch.setattr(sys, "meta_path", [Interrupted(), *sys.meta_path])
    assert run_program(["doctor"]) == ExitCode.INTERRUPTED
    assert capsys.readouterr().err == "dualbrain: interrupted\n"
