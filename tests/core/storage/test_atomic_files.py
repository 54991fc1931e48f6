"""A failed write reports its cause, and `require_writable` finds it before long work begins."""

import errno
import os
import tempfile

import pytest

from dualbrain.core.storage import atomic_files
from dualbrain.core.storage.atomic_files import (
    FileWriteError,
    atomic_file,
    atomic_folder,
    require_writable,
    write_atomically,
)


@pytest.mark.parametrize(
    ("code", "full"),
    [(errno.ENOSPC, True), (errno.EDQUOT, True), (errno.ENOENT, False), (errno.EACCES, False), (errno.EISDIR, False)],
)
def test_only_a_full_disk_asks_for_more_space(tmp_path, monkeypatch, code, full):
    def fail(*_, **__):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(tempfile, "mkstemp", fail)
    with pytest.raises(FileWriteError) as raised:
        write_atomically(tmp_path / "m.json", b"")
    assert os.strerror(code) in str(raised.value)
    assert ("Free some space" in str(raised.value)) is full


def test_require_writable_makes_the_folder_and_leaves_existing_files_unchanged(tmp_path):
    path = tmp_path / "a" / "b" / "m.json"
    require_writable(path)
    assert list(tmp_path.rglob("*")) == [path.parent.parent, path.parent]
    write_atomically(path, b"old")
    require_writable(path)
    assert (path.read_bytes(), list(path.parent.iterdir())) == (b"old", [path])


@pytest.mark.parametrize("name", ["file/m.json", "folder", f"folder/{'m' * 255}"])
def test_require_writable_refuses_a_path_that_cannot_be_written(tmp_path, name):
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    for write in (require_writable, lambda path: write_atomically(path, b"new")):
        with pytest.raises(FileWriteError, match="Fix this, or give another path"):
            write(tmp_path / name)
    assert sorted(tmp_path.rglob("*")) == [tmp_path / "file", tmp_path / "folder"]


@pytest.fixture
def umask():
    """Set the umask for this test."""
    before = os.umask(0)
    yield os.umask
    os.umask(before)


@pytest.mark.parametrize(("mask", "folder", "file"), [(0o022, 0o755, 0o644), (0o027, 0o750, 0o640), (0, 0o777, 0o666)])
def test_permissions_of_atomic_files_and_folders_follow_the_umask(tmp_path, umask, mask, folder, file):
    umask(mask)
    with atomic_file(tmp_path / "m.gguf") as temporary:
        temporary.write_bytes(b"new")
    with atomic_folder(tmp_path / "peft") as temporary:
        (temporary / "m.json").write_bytes(b"new")
    modes = [path.stat().st_mode & 0o777 for path in sorted(tmp_path.rglob("*"))]
    assert modes == [file, folder, file]
    write_atomically(tmp_path / "private", b"")
    assert (tmp_path / "private").stat().st_mode & 0o777 == 0o600


def test_an_atomic_folder_may_have_folders(tmp_path):
    with atomic_folder(tmp_path / "out") as temporary:
        (temporary / "a" / "b").mkdir(parents=True)
        (temporary / "a" / "b" / "file").write_bytes(b"new")
    assert (tmp_path / "out" / "a" / "b" / "file").read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [tmp_path / "out"]


def write_until_the_disk_is_full(atomic, path):
    """Write half of the content, then fail because the disk is full."""
    with atomic(path) as temporary:
        (temporary if temporary.is_file() else temporary / "half").write_bytes(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("atomic", [atomic_file, atomic_folder])
def test_an_interrupted_write_leaves_nothing_and_an_occupied_path_is_an_error(tmp_path, atomic):
    with pytest.raises(FileWriteError, match="No space left"):
        write_until_the_disk_is_full(atomic, tmp_path / "out")
    with pytest.raises(KeyboardInterrupt), atomic(tmp_path / "out"):
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").touch()
    for occupied in (tmp_path / "file" / "out", tmp_path):
        with pytest.raises(FileWriteError), atomic(occupied):
            pass
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]


def write_bytes(path, data):
    with atomic_file(path) as temporary:
        temporary.write_bytes(data)


def write_folder(path, data):
    with atomic_folder(path) as temporary:
        (temporary / "file").write_bytes(data)


@pytest.mark.parametrize("write", [write_atomically, write_bytes, write_folder])
def test_a_folder_that_cannot_be_synced_does_not_count_as_unchanged_content(tmp_path, monkeypatch, write):
    def fail(folder):
        if folder == tmp_path:
            raise OSError(errno.EIO, os.strerror(errno.EIO))

    path = tmp_path / "m.json"
    if write is not write_folder:
        write(path, b"old")
    monkeypatch.setattr(atomic_files, "fsync_folder", fail)
    with pytest.raises(FileWriteError, match=r"has its new content.*Input/output error.*Check its disk") as raised:
        write(path, b"new")
    assert raised.value.is_replaced
    assert "unchanged" not in str(raised.value)
    assert (path / "file" if write is write_folder else path).read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]
