"""What cannot be written is told by its cause, and where the work is long, before it begins."""

import errno
import os
import tempfile

import pytest

from dualbrain.adaptation.durable import DiskFull, require_place, write_durably


@pytest.mark.parametrize(
    ("code", "full"),
    [(errno.ENOSPC, True), (errno.EDQUOT, True), (errno.ENOENT, False), (errno.EACCES, False), (errno.EISDIR, False)],
)
def test_only_where_there_is_no_room_more_is_asked_for(tmp_path, monkeypatch, code, full):
    def fail(*told, **more):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(tempfile, "mkstemp", fail)
    with pytest.raises(DiskFull) as raised:
        write_durably(tmp_path / "m.json", b"")
    assert os.strerror(code) in str(raised.value)
    assert ("Free some space" in str(raised.value)) is full


def test_a_place_that_is_fit_is_made_and_left_as_it_was(tmp_path):
    path = tmp_path / "a" / "b" / "m.json"
    require_place(path)
    assert list(tmp_path.rglob("*")) == [path.parent.parent, path.parent]
    write_durably(path, b"old")
    require_place(path)
    assert (path.read_bytes(), list(path.parent.iterdir())) == (b"old", [path])


@pytest.mark.parametrize("place", ["file/m.json", "folder", f"folder/{'m' * 255}"])
def test_where_nothing_can_be_written_it_is_told_before(tmp_path, place):
    (tmp_path / "file").touch()
    (tmp_path / "folder").mkdir()
    for tried in (require_place, lambda path: write_durably(path, b"new")):
        with pytest.raises(DiskFull, match="Mend that, or name another place"):
            tried(tmp_path / place)
    assert sorted(tmp_path.rglob("*")) == [tmp_path / "file", tmp_path / "folder"]
