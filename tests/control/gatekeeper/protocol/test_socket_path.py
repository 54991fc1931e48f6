"""The path of the gatekeeper's socket: only a stale socket of this user is replaced; only the own one is removed."""

import os
import socket
import stat
from collections.abc import Iterator
from pathlib import Path

import pytest

from dualbrain.control.gatekeeper.protocol import server as server_module
from dualbrain.control.gatekeeper.protocol.server import SocketServer, is_listening
from dualbrain.errors import ConfigurationError


@pytest.fixture
def path(tmp_path) -> Iterator[Path]:
    return tmp_path / "s"


def bound(path: Path, kind: int = socket.SOCK_STREAM) -> socket.socket:
    one = socket.socket(socket.AF_UNIX, kind)
    one.bind(str(path))
    return one


MAKERS = {
    "a regular file": lambda path: path.write_text("precious"),
    "a folder": lambda path: path.mkdir(),
    "a named pipe": os.mkfifo,
    "a symbolic link": lambda path: path.symlink_to(path.with_name("target")),
}


@pytest.mark.parametrize("kind", MAKERS)
def test_anything_but_a_socket_is_refused_by_name_and_left_as_it_is(path, kind):
    path.with_name("target").write_text("precious")
    MAKERS[kind](path)
    before = path.lstat()
    with pytest.raises(ConfigurationError, match=f"{path} is {kind} and not a socket.*--socket"):
        SocketServer(path)
    after = path.lstat()
    assert (after.st_ino, after.st_mode, after.st_size) == (before.st_ino, before.st_mode, before.st_size)
    assert path.with_name("target").read_text() == "precious"


def test_a_dangling_link_and_a_link_to_a_stale_socket_are_refused(path):
    bound(path.with_name("stale")).close()
    for target in ("nowhere", "stale"):
        path.symlink_to(path.with_name(target))
        with pytest.raises(ConfigurationError, match="is a symbolic link and not a socket"):
            SocketServer(path)
        path.unlink()
    assert path.with_name("stale").is_socket()


def test_the_socket_of_another_user_is_refused(path, monkeypatch):
    bound(path).close()
    monkeypatch.setattr(os, "geteuid", lambda: path.lstat().st_uid + 1)
    with pytest.raises(ConfigurationError, match="belongs to another user"):
        SocketServer(path)
    assert path.is_socket()


@pytest.mark.parametrize("kind", [socket.SOCK_DGRAM, socket.SOCK_SEQPACKET])
def test_a_socket_of_another_program_is_refused(path, kind):
    with bound(path, kind) as other:
        if kind == socket.SOCK_SEQPACKET:
            other.listen()
        with pytest.raises(ConfigurationError, match="in use by another program"):
            SocketServer(path)
        assert path.is_socket()


def test_a_listener_with_a_full_backlog_is_in_use(path):
    with bound(path) as busy:
        busy.listen(0)
        waiting = []
        for _ in range(4):
            one = socket.socket(socket.AF_UNIX)
            one.setblocking(False)
            one.connect_ex(str(path))
            waiting.append(one)
        assert is_listening(path)
        with pytest.raises(ConfigurationError, match="in use by a running gatekeeper"):
            SocketServer(path)
        for one in waiting:
            one.close()


def test_close_removes_only_the_own_socket(path):
    for replace in (lambda: path.write_text("precious"), lambda: bound(path).close(), lambda: None):
        server = SocketServer(path)
        path.unlink()
        replace()
        before = path.lstat().st_ino if path.exists() else None
        server.close()
        assert (path.lstat().st_ino if path.exists() else None) == before
        path.unlink(missing_ok=True)
    SocketServer(path).close()
    assert not path.exists()


def test_the_socket_and_new_folders_are_private_with_every_umask(tmp_path):
    before = os.umask(0)
    try:
        server = SocketServer(tmp_path / "new" / "deep" / "s")
    finally:
        os.umask(before)
    server.close()
    assert [stat.S_IMODE(one.stat().st_mode) for one in (tmp_path / "new", tmp_path / "new" / "deep")] == [0o700, 0o700]


def test_a_path_that_is_too_long_is_refused_without_a_leak(tmp_path):
    with pytest.raises(ConfigurationError, match="107 bytes"):
        SocketServer(tmp_path / ("s" * 120))
    assert not is_listening(tmp_path / ("s" * 120))
    assert server_module._file_identity(tmp_path / "s") is None
