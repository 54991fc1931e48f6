"""Key files: one private file per principal, wrong permissions, and the split of the old single file."""

import os
import stat
from pathlib import Path

import msgspec
import pytest

from dualbrain.control.gatekeeper.protocol.authentication import PRINCIPALS, load_keys
from dualbrain.errors import ConfigurationError

OLD_SECRETS = {"planner": b"p" * 32, "operator": b"o" * 32}


@pytest.fixture(params=[0, 0o022, 0o777])
def umask(request):
    """Any umask: the permissions of keys do not depend on it."""
    before = os.umask(request.param)
    yield request.param
    os.umask(before)


def write_old_file(path: Path) -> Path:
    path.write_bytes(msgspec.json.encode({"secrets": OLD_SECRETS}))
    path.chmod(0o600)
    return path


def mode(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_keys_are_private_with_every_umask(tmp_path, umask):
    folder = tmp_path / "keys"
    load_keys(folder, PRINCIPALS)
    assert mode(folder) == 0o700
    assert {path.name: mode(path) for path in folder.iterdir()} == {"planner.key": 0o600, "operator.key": 0o600}


def test_a_principal_reads_only_its_own_secret(tmp_path, monkeypatch):
    both = load_keys(tmp_path / "keys", PRINCIPALS).secrets
    assert load_keys(tmp_path / "keys", ("planner",)).secrets == {"planner": both["planner"]}
    opened, open_file = [], os.open
    monkeypatch.setattr(
        os, "open", lambda path, *rest, **options: opened.append(path) or open_file(path, *rest, **options)
    )
    load_keys(tmp_path / "keys", ("planner",))
    assert [Path(path).name for path in opened] == ["planner.key"]


def test_a_commander_without_keys_creates_no_key_of_the_operator(tmp_path):
    load_keys(tmp_path / "keys", ("planner",))
    assert [path.name for path in (tmp_path / "keys").iterdir()] == ["planner.key"]


@pytest.mark.parametrize("bits", [0o640, 0o604, 0o602, 0o660, 0o644, 0o610])
def test_a_key_file_that_others_can_use_is_refused_with_the_command(tmp_path, bits):
    load_keys(tmp_path / "keys", PRINCIPALS)
    path = tmp_path / "keys" / "operator.key"
    path.chmod(bits)
    with pytest.raises(ConfigurationError, match=rf"the mode {bits:o}.* Run chmod 600 {path}"):
        load_keys(tmp_path / "keys", ("operator",))
    load_keys(tmp_path / "keys", ("planner",))


@pytest.mark.parametrize("bits", [0o755, 0o770, 0o701])
def test_a_key_folder_that_others_can_use_is_refused_with_the_command(tmp_path, bits):
    folder = tmp_path / "keys"
    load_keys(folder, PRINCIPALS)
    folder.chmod(bits)
    with pytest.raises(ConfigurationError, match=rf"the mode {bits:o}.* Run chmod 700 {folder}"):
        load_keys(folder, PRINCIPALS)


def test_links_pipes_and_folders_in_place_of_a_key_are_refused(tmp_path):
    folder, path = tmp_path / "keys", tmp_path / "keys" / "planner.key"
    load_keys(folder, PRINCIPALS)
    other = tmp_path / "other"
    other.write_text("ab" * 32)
    other.chmod(0o600)
    for make, kind in (
        (lambda: path.symlink_to(other), "a symbolic link"),
        (lambda: path.symlink_to(tmp_path / "nowhere"), "a symbolic link"),
        (lambda: os.mkfifo(path), "a named pipe"),
        (path.mkdir, "a folder"),
    ):
        path.rmdir() if path.is_dir() else path.unlink()
        make()
        with pytest.raises(ConfigurationError, match=f"planner.key is {kind}, not a regular file"):
            load_keys(folder, PRINCIPALS)
    (tmp_path / "linked").symlink_to(folder)
    with pytest.raises(ConfigurationError, match=r"key folder .* is a symbolic link, not a folder"):
        load_keys(tmp_path / "linked", PRINCIPALS)


@pytest.mark.parametrize("content", [b"", b"zz" * 32, b"ab" * 31, b"ab" * 600, b"\xff" * 64, b"{}"])
def test_a_damaged_key_is_refused(tmp_path, content):
    load_keys(tmp_path / "keys", PRINCIPALS)
    (tmp_path / "keys" / "planner.key").write_bytes(content)
    with pytest.raises(ConfigurationError, match=r"Delete it; (a new key is|new keys are) then created"):
        load_keys(tmp_path / "keys", PRINCIPALS)


@pytest.mark.parametrize("name", ["keys.json", "keys"])
def test_an_old_key_file_is_split_once_and_removed(tmp_path, umask, name):
    old, folder = write_old_file(tmp_path / name), tmp_path / "keys"
    keys = load_keys(folder, PRINCIPALS)
    assert keys.secrets == OLD_SECRETS
    assert "planner.key, operator.key" in keys.notice
    assert old == folder or not old.exists()
    assert sorted(path.name for path in tmp_path.rglob("*")) == ["keys", "operator.key", "planner.key"]
    assert {mode(path) for path in folder.iterdir()} == {0o600}
    again = load_keys(folder, PRINCIPALS)
    assert (again.secrets, again.notice) == (OLD_SECRETS, "")


def test_a_commander_does_not_read_an_old_key_file(tmp_path):
    old = write_old_file(tmp_path / "keys.json")
    with pytest.raises(ConfigurationError, match=r"holds the secrets of all principals.*dualbrain gatekeeper"):
        load_keys(tmp_path / "keys", ("planner",))
    assert old.exists()
    assert not (tmp_path / "keys").exists()


def test_an_old_key_file_that_others_can_read_is_not_split(tmp_path):
    old = write_old_file(tmp_path / "keys.json")
    old.chmod(0o644)
    with pytest.raises(ConfigurationError, match=f"the mode 644.* Run chmod 600 {old}"):
        load_keys(tmp_path / "keys", PRINCIPALS)


def test_an_interrupted_split_is_finished(tmp_path):
    write_old_file(tmp_path / "keys.old")
    assert load_keys(tmp_path / "keys", PRINCIPALS).secrets == OLD_SECRETS
    assert not (tmp_path / "keys.old").exists()
