"""The address of `dualbrain operate`: the gatekeeper of the data folder, or else the only one that runs."""

import threading
import time
from contextlib import ExitStack

import pytest

from dualbrain.cli.common import running_gatekeepers
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.running_gatekeepers import REGISTRATIONS
from dualbrain.cli.main import run_command_line
from dualbrain.cli.servers.gatekeeper import running_address
from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.process import GatekeeperProcess
from dualbrain.control.gatekeeper.protocol import emergency_stop
from dualbrain.control.gatekeeper.protocol.authentication import load_keys, read_keys
from dualbrain.control.gatekeeper.protocol.registration import Registration
from dualbrain.errors import ConfigurationError, UsageError
from dualbrain.simulation.scenes.generators.catalogue import open_scene

NO_PROCESS = 2**30
"""A number that no process has."""


@pytest.fixture(autouse=True)
def no_other_processes(monkeypatch):
    monkeypatch.setattr(running_gatekeepers, "_from_process_list", lambda: iter(()))


def running(monkeypatch, *folders):
    """Gatekeepers of the list of processes, each with its socket and its keys in a folder."""
    found = [
        Registration(
            pid=NO_PROCESS + number,
            start_ticks=None,
            robot="panda",
            socket=str(folder / "socket"),
            keys=str(folder / "keys"),
            started_by="a test",
        )
        for number, folder in enumerate(folders)
    ]
    monkeypatch.setattr(running_gatekeepers, "_from_process_list", lambda: iter(found))


def test_the_gatekeeper_of_the_data_folder_has_precedence(tmp_path, monkeypatch):
    running(monkeypatch, tmp_path / "other")
    (tmp_path / "gatekeeper.sock").touch()
    assert running_address(tmp_path, None) == (tmp_path / "gatekeeper.sock", tmp_path / "keys")


def test_the_only_running_one_is_found_and_of_several_none_is_chosen(tmp_path, monkeypatch):
    one, two = tmp_path / "a b", tmp_path / "c"
    running(monkeypatch, one)
    assert running_address(tmp_path, None) == (one / "socket", one / "keys")
    running(monkeypatch, one, two)
    with pytest.raises(UsageError) as caught:
        running_address(tmp_path, None)
    assert f"--socket '{one / 'socket'}' --keys '{one / 'keys'}'" in str(caught.value)
    assert f"--socket {two / 'socket'} --keys {two / 'keys'}" in str(caught.value)


def test_the_keys_of_a_named_socket_are_found(tmp_path, monkeypatch):
    one, two = tmp_path / "a", tmp_path / "c"
    running(monkeypatch, one, two)
    assert running_address(tmp_path, two / "socket") == (two / "socket", two / "keys")
    assert running_address(tmp_path, tmp_path / "unknown") == (tmp_path / "unknown", tmp_path / "keys")


@pytest.mark.parametrize("act", ["pause", "resume", "hand_back", "reset"])
def test_a_speed_that_a_command_would_ignore_is_refused(act, tmp_path, capsys):
    """`operate resume --speed 10%` continued the motion at the former speed."""
    arguments = ["operate", act, "--speed", "10%", "--socket", str(tmp_path / "socket"), "--keys", str(tmp_path)]
    assert run_command_line(arguments) == 2
    assert "dualbrain operate speed --speed 10%" in capsys.readouterr().err


def test_an_emergency_stop_is_sent_with_any_other_option(tmp_path, capsys):
    assert run_command_line(["operate", "estop", "--speed", "10%", "--socket", str(tmp_path / "socket")]) == 5
    assert "The emergency stop is not confirmed" in capsys.readouterr().err


def test_with_socket_and_keys_no_process_is_looked_for(tmp_path, monkeypatch, capsys):
    def refuse(*_):
        raise AssertionError("the list of processes was read")

    monkeypatch.setattr(running_gatekeepers, "_from_process_list", refuse)
    monkeypatch.setattr(running_gatekeepers, "read_registrations", refuse)
    load_keys(tmp_path / "keys", ("operator",))
    arguments = ["operate", "pause", "--socket", str(tmp_path / "socket"), "--keys", str(tmp_path / "keys")]
    assert run_command_line(arguments) == 5
    assert str(tmp_path / "socket") in capsys.readouterr().err


def test_the_sockets_are_those_of_the_gatekeepers_that_are_found(tmp_path, monkeypatch):
    one, two = tmp_path / "a", tmp_path / "c"
    running(monkeypatch, one, two, one)
    assert running_gatekeepers.running_sockets(tmp_path) == [one / "socket", two / "socket"]
    registered = Registration(
        pid=NO_PROCESS, start_ticks=None, robot="panda", socket=str(tmp_path / "own"), keys="", started_by="a test"
    )
    monkeypatch.setattr(running_gatekeepers, "read_registrations", lambda _: [registered])
    assert running_gatekeepers.running_sockets(tmp_path) == [tmp_path / "own", two / "socket", one / "socket"]


@pytest.mark.parametrize("threads", [True, False])
def test_a_gatekeeper_that_does_not_answer_delays_the_stop_of_no_other(tmp_path, monkeypatch, capsys, threads):
    """Each stop waits for the other one: one after another, the first would wait in vain."""
    silent, other, stopped = tmp_path / "silent", tmp_path / "other", threading.Event()

    def send(where):
        if where == other:
            stopped.set()
            return ""
        return "" if stopped.wait(10.0 if threads else 0.0) else "it does not answer"

    def no_thread(thread):
        raise RuntimeError("can't start new thread")

    if not threads:  # then one after another: none is left out
        monkeypatch.setattr(threading.Thread, "start", no_thread)
    monkeypatch.setenv("DUALBRAIN_HOME", str(tmp_path))
    monkeypatch.setattr(emergency_stop, "send_emergency_stop", send)
    monkeypatch.setattr(running_gatekeepers, "running_sockets", lambda home: [silent, other, silent])
    assert run_command_line(["operate", "estop"]) == (ExitCode.SUCCESS if threads else ExitCode.SETUP)
    assert stopped.is_set()
    text = "".join(capsys.readouterr())
    assert text.count(f"reported by the gatekeeper at {other}") == 1
    assert (f"reported by the gatekeeper at {silent}" in text) == threads


def test_a_client_never_creates_a_key(tmp_path):
    with pytest.raises(ConfigurationError, match=r"no operator.key: no gatekeeper was started with it.*doctor"):
        read_keys(tmp_path / "keys", ("operator",))
    assert not (tmp_path / "keys").exists()
    secrets = load_keys(tmp_path / "keys", ("planner",)).secrets
    assert read_keys(tmp_path / "keys", ("planner",)).secrets == secrets
    with pytest.raises(ConfigurationError, match=r"no operator.key"):
        read_keys(tmp_path / "keys", ("operator",))
    assert [path.name for path in (tmp_path / "keys").iterdir()] == ["planner.key"]


@pytest.mark.realtime
def test_an_emergency_stop_of_a_robot_that_a_program_started_is_released_without_an_address(
    tmp_path, monkeypatch, capsys
):
    home, place = tmp_path / "home", tmp_path / "place"
    place.mkdir()
    monkeypatch.setenv("DUALBRAIN_HOME", str(home))
    config = GatekeeperConfig(
        robot="panda",
        scene=open_scene("bare:0", "panda"),
        socket=str(place / "socket"),
        keys=str(place / "keys"),
        registrations=str(home / REGISTRATIONS),
        started_by="a test",
    )
    with ExitStack() as stack:
        process = GatekeeperProcess(config)
        stack.callback(process.stop)
        deadline = time.monotonic() + 30.0
        while not list((home / REGISTRATIONS).glob("*.json")):
            assert time.monotonic() < deadline
            time.sleep(0.02)
        assert run_command_line(["operate", "estop"]) == 0
        for act in ("release_estop", "reset", "resume"):
            assert run_command_line(["operate", act]) == 0, capsys.readouterr().err
        assert "resume: " in capsys.readouterr().err
        wrong = tmp_path / "wrong"
        load_keys(wrong, ("operator",))
        assert run_command_line(["operate", "pause", "--socket", config.socket, "--keys", str(wrong)]) == 5
        assert "its key is not one of this gatekeeper. Name the key folder with --keys" in capsys.readouterr().err
