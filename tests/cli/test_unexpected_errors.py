"""An unexpected exception is reported with its traceback, and is neither a success nor a task that failed safely."""

from dualbrain.cli import main
from dualbrain.cli.common.exit_codes import ExitCode


def test_a_defect_is_no_safe_failure(monkeypatch, capsys):
    def broken(*arguments, **options):
        raise ZeroDivisionError("no such thing")

    monkeypatch.setattr(main, "app", broken)
    assert main.run_command_line(["doctor"]) == ExitCode.SETUP
    assert "ZeroDivisionError: no such thing" in capsys.readouterr().err
