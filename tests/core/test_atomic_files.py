"""What cannot be written is told by its cause, and where the work is long, before it begins."""

import errno
import os
import tempfile

import pytest

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
def test_only_where_there_is_no_room_more_is_asked_for(tmp_path, monkeypatch, code, full):
    def fail(*told, **more):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(tempfile, "mkstemp", fail)
    with pytest.raises(FileWriteError) as raised:
        write_atomically(tmp_path / "m.json", b"")
    assert os.strerror(code) in str(raised.value)
    assert ("Free some space" in str(raised.value)) is full


def test_a_place_that_is_fit_is_made_and_left_as_it_was(tmp_path):
    path = tmp_path / "a" / "b" / "m.json"
    require_writable(path)
    assert list(tmp_path.rglob("*")) == [path.parent.parent, path.parent]
    write_atomically(path, b"old")
    require_writable(path)
    assert (path.read_bytes(), list(path.parent.iterdir())) == (b"old", [path])


@pytest.mark.parametrize("place", ["file/m.json", "folder", f"folder/{'m' * 255}"])
def test_where_nothing_can_be_written_it_is_told_before(tmp_path, place):
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    for tried in (require_writable, lambda path: write_atomically(path, b"new")):
        with pytest.raises(FileWriteError, match="Mend that, or name another place"):
            tried(tmp_path / place)
    assert sorted(tmp_path.rglob("*")) == [tmp_path / "file", tmp_path / "folder"]


@pytest.fixture
def umask():
    """Set the umask for this test."""
    before = os.umask(0)
    yield os.umask
    os.umask(before)


@pytest.mark.parametrize(("mask", "folder", "file"), [(0o022, 0o755, 0o644), (0o027, 0o750, 0o640), (0, 0o777, 0o666)])
def test_who_may_read_what_is_written_for_others_is_for_the_umask_to_say(tmp_path, umask, mask, folder, file):
    umask(mask)
    with atomic_file(tmp_path / "m.gguf") as beside:
        beside.write_bytes(b"new")
    with atomic_folder(tmp_path / "peft") as beside:
        (beside / "m.json").write_bytes(b"new")
    modes = [path.stat().st_mode & 0o777 for path in sorted(tmp_path.rglob("*"))]
    assert modes == [file, folder, file]
    write_atomically(tmp_path / "private", b"")
    assert (tmp_path / "private").stat().st_mode & 0o777 == 0o600


def half_written(place, path):
    """A disk that is full before the end."""
    with place(path) as beside:
        (beside if beside.is_file() else beside / "half").write_bytes(b"half")
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


@pytest.mark.parametrize("place", [atomic_file, atomic_folder])
def test_what_was_not_finished_is_gone_and_what_cannot_be_moved_there_is_told(tmp_path, place):
    with pytest.raises(FileWriteError, match="No space left"):
        half_written(place, tmp_path / "out")
    with pytest.raises(KeyboardInterrupt), place(tmp_path / "out"):
        raise KeyboardInterrupt
    assert not list(tmp_path.iterdir())
    (tmp_path / "file").touch()
    for taken in (tmp_path / "file" / "out", tmp_path):
        with pytest.raises(FileWriteError), place(taken):
            pass
    assert list(tmp_path.iterdir()) == [tmp_path / "file"]
