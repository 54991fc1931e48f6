"""Reserved space occupies the disk, is free after its release, and leaves no file, however its process ends."""

import errno
import os
import subprocess
import sys

import pytest

from dualbrain.core.storage import reserved_space as module
from dualbrain.core.storage.reserved_space import ReservedSpace
from dualbrain.errors import ConfigurationError

SIZE = 4_000_000


def free(folder):
    found = os.statvfs(folder)
    return found.f_bfree * found.f_frsize


def test_the_space_is_taken_until_its_release_and_has_no_name(small_disk):
    before = free(small_disk)
    reserve = ReservedSpace(small_disk, SIZE, "a test")
    assert reserve.is_held
    assert before - free(small_disk) >= SIZE
    assert list(small_disk.iterdir()) == []
    assert (reserve.release(), reserve.release(), reserve.is_held) == (True, False, False)
    assert free(small_disk) == before


def test_the_space_is_lent_and_taken_again_as_far_as_there_is_room(small_disk):
    reserve = ReservedSpace(small_disk, SIZE, "a test")
    with reserve.lent():
        (small_disk / "file").write_bytes(bytes(SIZE // 2))
    assert reserve.is_held
    left = free(small_disk)
    with reserve.lent():
        (small_disk / "large").write_bytes(bytes(left + SIZE // 2))
    assert not reserve.is_held
    with reserve.lent():
        pass
    assert not reserve.is_held


def test_a_disk_without_room_is_refused_in_a_sentence(small_disk):
    with pytest.raises(ConfigurationError) as raised:
        ReservedSpace(small_disk, free(small_disk) + SIZE, "the memory ledger")
    for part in ("MB for the memory ledger", str(small_disk), "No space left on device", "Free some space"):
        assert part in str(raised.value)
    assert free(small_disk) > SIZE


@pytest.mark.parametrize("code", [errno.EROFS, errno.EDQUOT, errno.EIO, errno.EFBIG])
def test_every_error_of_the_disk_is_refused_with_a_remedy(tmp_path, monkeypatch, code):
    def fail(*_):
        raise OSError(code, os.strerror(code))

    monkeypatch.setattr(os, "posix_fallocate", fail)
    with pytest.raises(ConfigurationError, match=os.strerror(code)):
        ReservedSpace(tmp_path, SIZE, "a test")
    assert list(tmp_path.iterdir()) == []


def test_a_system_without_allocation_writes_the_space(tmp_path, monkeypatch):
    monkeypatch.delattr(os, "posix_fallocate")
    reserve = ReservedSpace(tmp_path, 3 * module.BLOCK_BYTES // 2, "a test")
    assert os.fstat(reserve._file.fileno()).st_size == 3 * module.BLOCK_BYTES // 2
    reserve.release()


def test_a_missing_folder_is_refused(tmp_path):
    with pytest.raises(ConfigurationError, match="No such file"):
        ReservedSpace(tmp_path / "missing", SIZE, "a test")


def test_a_killed_process_leaves_nothing(small_disk):
    program = (
        "import os, signal, sys; from pathlib import Path; "
        "from dualbrain.core.storage.reserved_space import ReservedSpace; "
        f"reserve = ReservedSpace(Path(sys.argv[1]), {SIZE}, 'a test'); os.kill(os.getpid(), signal.SIGKILL)"
    )
    before = free(small_disk)
    subprocess.run([sys.executable, "-c", program, str(small_disk)], check=False)
    assert (free(small_disk), list(small_disk.iterdir())) == (before, [])
