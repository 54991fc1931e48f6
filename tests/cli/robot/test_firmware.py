"""`dualbrain robot firmware`: the file of the key."""

import os
import stat

import pytest

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.robot.firmware import _read_key
from dualbrain.safety.target.build import KEY_BYTES


def test_a_new_key_is_private_and_is_kept(tmp_path):
    path = tmp_path / "firmware.key"
    key = _read_key(path)
    assert (len(key), stat.S_IMODE(path.stat().st_mode)) == (KEY_BYTES, 0o600)
    assert _read_key(path) == key != _read_key(tmp_path / "other.key")


@pytest.mark.parametrize("size", [0, KEY_BYTES - 1, KEY_BYTES + 1, 100_000])
def test_a_file_that_is_no_key_is_named_and_kept(run_command, tmp_path, size):
    path = tmp_path / "wrong.key"
    path.write_bytes(bytes(size))
    code, _, err = run_command("robot", "firmware", "--key", str(path))
    assert code == ExitCode.USAGE
    assert "wrong.key" in err
    assert path.stat().st_size == size


def test_a_pipe_is_refused_without_waiting(run_command, tmp_path):
    os.mkfifo(tmp_path / "pipe")
    code, _, err = run_command("robot", "firmware", "--key", str(tmp_path / "pipe"))
    assert (code, "pipe" in err) == (ExitCode.USAGE, True)
