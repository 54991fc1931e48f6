"""The emergency stop has no preconditions: a matrix of broken environments in which it still arrives."""

import os
import resource
import socket
import subprocess
import sys
import threading
import time
from contextlib import ExitStack, suppress

import pytest

from dualbrain.cli.common import running_gatekeepers
from dualbrain.cli.common.running_gatekeepers import REGISTRATIONS
from dualbrain.cli.main import run_command_line
from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError, GatekeeperClient
from dualbrain.control.gatekeeper.protocol.emergency_stop import send_emergency_stop
from dualbrain.control.gatekeeper.protocol.frames import encode
from dualbrain.control.gatekeeper.protocol.messages import Heartbeat, Propose, encode_body, kind_code
from dualbrain.control.gatekeeper.protocol.registration import registered
from dualbrain.control.gatekeeper.protocol.server import MAX_AUTHENTICATED, MAX_CONNECTIONS
from dualbrain.runtime.backends.gatekeeper import GatekeeperBackend
from tests.control.gatekeeper.lockstep_cell import lockstep_cell

PROGRAM = "import sys; from dualbrain.cli.main import run_command_line; sys.exit(run_command_line(sys.argv[1:]))"


@pytest.fixture
def cell(tmp_path):
    with lockstep_cell(tmp_path) as cell:
        yield cell


def raw_connection(path):
    """A connection that has sent nothing."""
    link = socket.socket(socket.AF_UNIX, socket.SOCK_STREAM)
    deadline = time.monotonic() + 20.0
    while True:
        try:
            link.connect(str(path))
        except BlockingIOError:  # the queue of the server is full
            assert time.monotonic() < deadline
        except BaseException:
            link.close()
            raise
        else:
            return link


def frame(message, number=1):
    return encode(kind_code(message), number, encode_body(message))


def press(cell, *arguments):
    """Press the emergency stop at the command line; its exit code."""
    return run_command_line(["operate", "estop", "--socket", str(cell.socket), *arguments])


def press_in_a_process(cell, *arguments, **environment):
    command = [sys.executable, "-c", PROGRAM, "operate", "estop", "--socket", str(cell.socket)]
    return subprocess.run([*command, *arguments], check=False, timeout=120.0, **environment).returncode


# --- keys ---------------------------------------------------------------------------------------------------------


def readable_by_all(path):
    path.write_bytes(b'{"secrets": {}}')
    path.chmod(0o644)


def torn(path):
    path.write_bytes(b'{"secrets": {"opera')
    path.chmod(0o600)


def without_operator(path):
    path.write_bytes(b'{"secrets": {"planner": "' + b"A" * 44 + b'"}}')
    path.chmod(0o600)


def unreadable(path):
    path.write_bytes(b"")
    path.chmod(0o000)


@pytest.mark.parametrize(
    "damage",
    [
        lambda path: None,
        readable_by_all,
        torn,
        without_operator,
        unreadable,
        lambda path: path.mkdir(),
        lambda path: path.symlink_to(path.parent / "nowhere"),
        os.mkfifo,
    ],
    ids=["missing", "readable by all", "torn", "without operator", "unreadable", "a folder", "a dead link", "a FIFO"],
)
def test_no_key_is_read(cell, tmp_path, damage, capsys):
    keys = tmp_path / "damaged"
    damage(keys)
    assert press(cell, "--keys", str(keys)) == 0
    cell.wait_for_action("ESTOP")
    assert "ESTOP" in capsys.readouterr().err


def test_the_address_file_of_a_run_is_enough(cell, tmp_path):
    (tmp_path / "gatekeeper.address").write_text(f"{cell.socket}\n{tmp_path / 'no keys'}\n")
    assert run_command_line(["operate", "estop", "--run", str(tmp_path)]) == 0
    cell.wait_for_action("ESTOP")


# --- connections --------------------------------------------------------------------------------------------------


def observers(cell, stack):
    for _ in range(2 * MAX_CONNECTIONS):
        stack.enter_context(raw_connection(cell.socket))


def operators(cell, stack):
    """As many authenticated connections as are allowed, and more that are refused."""
    refused = 0
    for _ in range(MAX_AUTHENTICATED + 4):
        try:
            client = GatekeeperClient(cell.socket, cell.keys, "operator")
        except ConnectionLostError:
            refused += 1
        else:
            stack.callback(client.close)
    assert refused == 4


def commander_with_half_a_frame(cell, stack):
    client = GatekeeperClient(cell.socket, cell.keys, "planner")
    stack.callback(client.close)
    message = Propose(contract=b"x" * 60_000, issued=0.0, expires=1.0, scene_version=1, mac=b"")
    client._socket.sendall(frame(message, client._sent + 1)[:30_000])


def flood_of_connections(cell, stack):
    """Clients that connect without end, send a little and are replaced."""
    over = threading.Event()

    def connect():
        while not over.is_set():
            with suppress(OSError), socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as link:
                link.settimeout(1.0)
                link.connect(str(cell.socket))
                link.sendall(frame(Heartbeat())[:7])

    threads = [threading.Thread(target=connect) for _ in range(3)]
    stack.callback(lambda: [thread.join() for thread in threads])
    stack.callback(over.set)
    for thread in threads:
        thread.start()


def malformed_bytes(cell, stack):
    for _ in range(20):
        stack.enter_context(raw_connection(cell.socket)).sendall(bytes(range(256)) * 8)


@pytest.mark.parametrize(
    "occupy", [observers, operators, commander_with_half_a_frame, flood_of_connections, malformed_bytes]
)
def test_a_connection_is_always_free(cell, occupy):
    with ExitStack() as stack:
        occupy(cell, stack)
        assert send_emergency_stop(cell.socket, timeout=20.0) == ""
        cell.wait_for_action("ESTOP")


def test_the_stop_behind_a_long_frame_of_the_same_connection_arrives(cell):
    observer = GatekeeperClient(cell.socket)
    with suppress(ConnectionLostError):
        message = Propose(contract=b"x" * 60_000, issued=0.0, expires=1.0, scene_version=1, mac=b"")
        observer.send(message)
        observer.operate("estop")
    cell.wait_for_action("ESTOP")
    observer.close()


class StuckGate:
    """A gate that never replies."""

    busy = True

    def submit(self, request):
        return False

    def take_reply(self):
        return None

    def close(self):
        pass


def test_the_stop_does_not_wait_for_the_gate(tmp_path):
    with lockstep_cell(tmp_path, gate=StuckGate()) as cell:
        assert send_emergency_stop(cell.socket, timeout=20.0) == ""
        cell.wait_for_action("ESTOP")


def test_the_live_view_stops_the_arm_when_the_connections_of_the_run_are_lost(cell):
    backend = GatekeeperBackend()
    backend._socket = cell.socket
    assert backend._operator is None
    assert backend.operate("estop") == ""
    cell.wait_for_action("ESTOP")


# --- environment --------------------------------------------------------------------------------------------------


def test_no_home_folder_is_needed(cell, tmp_path):
    environment = {name: os.environ[name] for name in ("PATH",) if name in os.environ}
    broken = {"HOME": "/nonexistent", "DUALBRAIN_HOME": str(tmp_path / "s" / "x"), "TMPDIR": "/nonexistent"}
    assert press_in_a_process(cell, env=environment | broken) == 0
    cell.wait_for_action("ESTOP")


def test_no_output_and_no_input_are_needed(cell):
    assert press_in_a_process(cell, preexec_fn=lambda: os.closerange(0, 3)) == 0
    cell.wait_for_action("ESTOP")


def test_a_removed_working_folder_is_no_obstacle(cell, tmp_path):
    folder = tmp_path / "gone"
    folder.mkdir()
    assert press_in_a_process(cell, cwd=folder, preexec_fn=lambda: os.rmdir(folder)) == 0
    cell.wait_for_action("ESTOP")


def test_no_file_can_be_written(cell):
    assert press_in_a_process(cell, preexec_fn=lambda: resource.setrlimit(resource.RLIMIT_FSIZE, (0, 0))) == 0
    cell.wait_for_action("ESTOP")


def test_without_an_address_every_running_gatekeeper_is_stopped(cell, tmp_path, monkeypatch, capsys):
    """One at the default socket, which is broken, and one that is registered."""
    home = tmp_path / "home"
    home.mkdir()
    (home / "gatekeeper.sock").write_text("no socket")
    monkeypatch.setenv("DUALBRAIN_HOME", str(home))
    monkeypatch.setattr(running_gatekeepers, "_from_process_list", lambda: iter(()))
    with registered(home / REGISTRATIONS, robot="panda", socket=str(cell.socket), keys="", started_by="a test"):
        assert run_command_line(["operate", "estop"]) == 5
    cell.wait_for_action("ESTOP")
    messages = capsys.readouterr().err
    assert "not confirmed" in messages
    assert f"reported by the gatekeeper at {cell.socket}" in messages


# --- no gatekeeper -------------------------------------------------------------------------------------------------


def test_a_stop_that_is_not_confirmed_is_not_reported_as_one(tmp_path, capsys):
    assert run_command_line(["operate", "estop", "--socket", str(tmp_path / "none")]) == 5
    message = capsys.readouterr().err
    assert "not confirmed" in message
    assert "Use the emergency stop of the robot itself." in message


def test_a_silent_server_is_not_a_confirmation(tmp_path):
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as silent:
        silent.bind(str(tmp_path / "s"))
        silent.listen()
        assert "did not report it in time" in send_emergency_stop(tmp_path / "s", timeout=0.1)


@pytest.mark.parametrize("path", ["a\0b", "x" * 300, ""])
def test_a_path_that_cannot_be_a_socket_is_a_reason(path):
    assert "no gatekeeper can be reached" in send_emergency_stop(path)
