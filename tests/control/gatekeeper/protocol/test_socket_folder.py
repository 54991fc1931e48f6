"""The temporary folder of a gatekeeper's socket: that of a killed program is removed by the next one, and no other."""

import os
import signal
import socket
import subprocess
import sys
import tempfile

import pytest

from dualbrain.control.gatekeeper.protocol.socket_folder import KEYS_NAME, SOCKET_NAME, socket_folder

PYTHON = [sys.executable, *(["-S"] if sys.flags.no_site else [])]
OWNER = """
import sys
from dualbrain.control.gatekeeper.protocol.socket_folder import KEYS_NAME, socket_folder

with socket_folder() as folder:
    (folder / KEYS_NAME).mkdir()
    print(folder, flush=True)
    sys.stdin.read()
"""


@pytest.fixture(autouse=True)
def parent(tmp_path, monkeypatch):
    """The folder for temporary files."""
    monkeypatch.setenv("TMPDIR", str(tmp_path))
    monkeypatch.setattr(tempfile, "tempdir", None)
    yield tmp_path
    tempfile.tempdir = None


@pytest.fixture
def owner():
    """Another program with a folder."""
    with subprocess.Popen([*PYTHON, "-c", OWNER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True) as one:
        yield one
        one.kill()


def folder_of(owner):
    return owner.stdout.readline().strip()


def test_the_folder_of_a_killed_program_is_removed_by_the_next_one(owner, parent):
    left = folder_of(owner)
    os.kill(owner.pid, signal.SIGKILL)
    owner.wait()
    assert os.path.isdir(os.path.join(left, KEYS_NAME))
    with socket_folder() as folder:
        assert list(parent.iterdir()) == [folder]
    assert list(parent.iterdir()) == []


def test_the_folder_of_a_running_program_stays(owner, parent):
    running = folder_of(owner)
    with socket_folder() as folder:
        assert sorted(map(str, parent.iterdir())) == sorted([str(folder), running])
    owner.stdin.close()
    owner.wait()
    assert list(parent.iterdir()) == []


def test_a_folder_in_which_a_gatekeeper_listens_stays(owner, parent):
    left = folder_of(owner)
    owner.kill()
    owner.wait()
    with socket.socket(socket.AF_UNIX) as listener:
        listener.bind(os.path.join(left, SOCKET_NAME))
        listener.listen()
        with socket_folder():
            assert os.path.isdir(left)
    with socket_folder():
        assert not os.path.exists(left)


def test_what_no_program_owns_stays(parent):
    (parent / "dualbrain-other").mkdir()
    (parent / "dualbrain-file").write_text("precious")
    (parent / "target").mkdir()
    (parent / "target" / "owner.lock").write_text("")
    (parent / "dualbrain-link").symlink_to(parent / "target")
    with socket_folder():
        pass
    assert {one.name for one in parent.iterdir()} == {"dualbrain-other", "dualbrain-file", "dualbrain-link", "target"}
