"""`dualbrain metrics`: served on this machine only, until a signal."""

import os
import signal
import socket
from threading import Timer
from urllib.request import urlopen

import pytest

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.main import run_command_line


@pytest.mark.parametrize("host", ["0.0.0.0", "192.0.2.1", "::", "example.org", ""])
def test_an_address_that_others_reach_is_refused(tmp_path, capsys, host):
    code = run_command_line(["metrics", "--socket", str(tmp_path / "s"), "--port", "0", "--host", host])
    assert code == ExitCode.USAGE
    assert "allowed: an address of this machine" in capsys.readouterr().err


def test_a_port_in_use_is_named(tmp_path, capsys):
    with socket.socket() as other:
        other.bind(("127.0.0.1", 0))
        other.listen()
        port = other.getsockname()[1]
        assert run_command_line(["metrics", "--socket", str(tmp_path / "s"), "--port", str(port)]) == ExitCode.SETUP
    assert f"127.0.0.1:{port}: Address already in use. Name another --port." in capsys.readouterr().err


def test_the_page_is_served_without_a_gatekeeper_until_a_signal(tmp_path, capsys):
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    pages = []

    def visit():
        with urlopen(f"http://127.0.0.1:{port}/metrics", timeout=10.0) as answer:
            pages.append(answer.read().decode())
        os.kill(os.getpid(), signal.SIGTERM)

    Timer(0.5, visit).start()
    assert run_command_line(["metrics", "--socket", str(tmp_path / "s"), "--port", str(port)]) == ExitCode.SUCCESS
    assert "dualbrain_up 0.0" in pages[0]
    assert "No gatekeeper listens at" in capsys.readouterr().err
