"""A closed pipe: progress and result are discarded, and the exit code does not change."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import dualbrain.cli

PROGRAM = """
import sys
from dualbrain.cli.common.console import StderrConsole, print_message, print_result
console = StderrConsole()
sys.stdin.readline()
for _ in range(3):
    console.print("a message")
    print_message("another one")
print_result("{}")
sys.exit(4)
"""


def exit_code_with_closed(**pipes):
    """The exit code of a program whose `pipes` are closed before it prints."""
    process = subprocess.Popen([sys.executable, "-c", PROGRAM], stdin=subprocess.PIPE, text=True, **pipes)
    for name, target in pipes.items():
        if target == subprocess.PIPE:
            getattr(process, name).close()
            setattr(process, name, None)
    process.stdin.write("\n")
    process.stdin.flush()
    process.wait(timeout=60)
    process.stdin.close()
    return process.returncode


def test_a_closed_stderr_keeps_result_and_exit_code(tmp_path):
    with (tmp_path / "out").open("w") as out:
        assert exit_code_with_closed(stderr=subprocess.PIPE, stdout=out) == 4
    assert (tmp_path / "out").read_text() == "{}\n"


def test_a_closed_stdout_keeps_messages_and_exit_code(tmp_path):
    with (tmp_path / "err").open("w") as err:
        assert exit_code_with_closed(stdout=subprocess.PIPE, stderr=err) == 4
    assert (tmp_path / "err").read_text().splitlines() == ["a message", "another one"] * 3


COMMAND_LINE = """
import sys
from dualbrain.__main__ import run_program
sys.stdin.readline()
sys.exit(run_program(sys.argv[1:]))
"""


@pytest.mark.parametrize("closed", ["stdout", "stderr"])
@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["--help"], 0),
        (["--version"], 0),
        (["knowledge", "list", "--help"], 0),
        (["run"], 2),
        (["no_command"], 2),
        (["check", "/none/c.json"], 5),
        (["replay", "/none/episode.mcap"], 5),
        (["robot", "inspect", "panda"], 0),
    ],
)
def test_a_closed_pipe_changes_no_exit_code(arguments: list[str], code: int, closed: str) -> None:
    pipes = {"stdout": subprocess.DEVNULL, "stderr": subprocess.DEVNULL} | {closed: subprocess.PIPE}
    process = subprocess.Popen(
        [sys.executable, "-c", COMMAND_LINE, *arguments], stdin=subprocess.PIPE, text=True, **pipes
    )
    getattr(process, closed).close()
    setattr(process, closed, None)
    process.communicate("\n", timeout=60)
    assert process.returncode == code


def test_every_command_prints_its_messages_through_the_console():
    folder = Path(dualbrain.cli.__file__).parent
    direct = [file.name for file in folder.rglob("*.py") if "file=sys.stderr" in file.read_text(encoding="utf-8")]
    assert direct == ["console.py"]


def test_a_listing_into_a_closed_pipe_ends_without_error(tmp_path):
    command = (
        "import sys; from dualbrain.cli.main import run_command_line as run; "
        "sys.stdin.readline(); sys.exit(run(['schema']))"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", command],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env={**os.environ, "PYTHONUNBUFFERED": ""},
    )
    process.stdout.close()
    process.stdout = None
    _, err = process.communicate(b"\n", timeout=60)
    assert process.returncode == 0
    assert err == b""


CLOSED = ["<&-", ">&-", "2>&-", "<&- >&- 2>&-"]


@pytest.mark.parametrize("closed", CLOSED)
def test_a_closed_stream_is_the_null_device(closed: str) -> None:
    """Without a standard input, `check -`, `run` and `shell` ended with a traceback."""
    command = f'exec "$0" -m dualbrain check - {closed}'
    arguments = ["sh", "-c", command, sys.executable]
    done = subprocess.run(arguments, input="", capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 3
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize("closed", CLOSED)
def test_no_file_gets_the_number_of_a_closed_stream(closed: str, tmp_path: Path) -> None:
    program = (
        "import sys; from dualbrain.__main__ import open_closed_streams; open_closed_streams(); "
        "sys.exit(open(sys.argv[1], 'w').fileno() > 2)"
    )
    command = f'exec "$0" -c "$1" "$2" {closed}'
    arguments = ["sh", "-c", command, sys.executable, program, str(tmp_path / "file")]
    assert subprocess.run(arguments, input=b"", timeout=60, check=False).returncode == 1
