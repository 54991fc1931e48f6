"""Untrusted text reaches the terminal without hidden characters, through every way of printing."""

import sys
from pathlib import Path

import pytest
from rich.console import Console
from rich.markup import escape
from rich.panel import Panel
from rich.table import Table

from dualbrain.cli.common import console as output
from dualbrain.cli.main import run_command_line
from dualbrain.errors import ConfigurationError
from dualbrain.robots.loader import data_file
from tests.core.untrusted.test_visible_text import TERMINAL_ATTACKS


def assert_inert(text: str) -> None:
    assert all(line.isprintable() for line in text.split("\n")), ascii(text)


@pytest.mark.parametrize("attack", TERMINAL_ATTACKS)
def test_printed_text_is_inert(attack: str, capsys: pytest.CaptureFixture[str]) -> None:
    output.print_result(f"a result: {attack}")
    output.print_message(f"a message: {attack}")
    output.print_table(("name",), [(attack,)])
    console = output.StderrConsole()
    console.print(f"[bold]an event[/]: {escape(attack)}")
    console.print(attack, markup=False, soft_wrap=True)
    console.print("several", attack, sep="|")
    console.print(Panel(attack, title="title"))
    table = Table(attack, title="a table")
    table.add_row(attack)
    console.print(table)
    printed = capsys.readouterr()
    assert_inert(printed.out)
    assert_inert(printed.err)
    assert "an event" in printed.err


@pytest.mark.parametrize("attack", TERMINAL_ATTACKS)
def test_errors_are_inert(attack: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> None:
    attack = attack.replace("\n", "")
    assert run_command_line(["check", f"/none/{attack}.json"]) != 0
    assert run_command_line([attack]) != 0
    assert run_command_line(["plan", "x", f"--{attack}"]) != 0
    for error in (ConfigurationError.stating(attack), RuntimeError(attack), OSError(5, attack)):

        def fail(*_: object, error: Exception = error, **__: object) -> None:
            raise error

        monkeypatch.setattr("dualbrain.cli.main.app", fail)
        assert run_command_line([]) != 0
        monkeypatch.undo()
    printed = capsys.readouterr()
    assert_inert(printed.out)
    assert_inert(printed.err)


def test_colours_of_the_program_remain(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    console = output.VisibleConsole(file=sys.stdout, force_terminal=True, color_system="standard", highlight=False)
    console.print("[red]text\x1b[2J[/]")
    assert capsys.readouterr().out == "\x1b[31mtext\\u001b[2J\x1b[0m\n"
    assert isinstance(console, Console)


MARKUP_FOLDER = Path("x[") / "red]" / "a[bold]c"
"""A path with the brackets of an opening and of a closing style; no style begins before the closing one."""


def test_a_run_names_its_folder_as_it_is(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The style `[bold]` was left out of the name, and `[/red]` ended the run with a traceback."""
    (contract := tmp_path / "contract.json").write_text("{}")
    out = tmp_path / MARKUP_FOLDER
    arguments = ["run", "--contract", str(contract), "--headless", "--out", str(out)]
    assert run_command_line([*arguments, "--ledger", str(tmp_path / "ledger.sqlite")]) == 3
    printed = capsys.readouterr().err
    assert f"panda, scene 0, {out}\n" in printed
    assert f"report: {out / 'report.html'}\n" in printed


@pytest.mark.parametrize("name", ["j4[conceal]", "j4[/x]", "a_joint_with_a_name_that_is_longer_than_a_narrow_column"])
def test_inspect_shows_every_name_whole(
    name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("COLUMNS", "60")
    text = data_file("panda").read_text(encoding="utf-8")
    (tmp_path / "body.json").write_text(text.replace('"panda_joint4"', f'"{name}"'), encoding="utf-8")
    run_command_line(["robot", "inspect", str(tmp_path)])
    assert f"\n{name} " in capsys.readouterr().out
