"""Stamps of verified files: the SHA-256 of a file with everything that changes when the file does.

A stamp spares the next program the reading of a large file. It is trusted only if no other user can have written the
file or the stamp: both are regular files of this user (or of root) that no other user can write, in a folder with the
same property. It names the device, inode, owner, size, time of modification and time of the last change of the inode;
a program can set the time of modification, but not the time of change. Without a trusted stamp the file is hashed
again. Programs of the same user are trusted, as everywhere in this package: they could change the package itself.
"""

from __future__ import annotations

import hashlib
import json
import os
import stat
from contextlib import suppress
from pathlib import Path

from dualbrain.core.storage.atomic_files import FileWriteError, write_atomically

_ROOT = 0
_NO_FOLLOW = os.O_RDONLY | os.O_CLOEXEC | os.O_NOFOLLOW | os.O_NONBLOCK
_MAX_STAMP_BYTES = 4096
_OTHERS_MAY_WRITE = stat.S_IWGRP | stat.S_IWOTH


def hash_file(path: Path) -> tuple[str, os.stat_result]:
    """SHA-256 of the file at `path` and its state; "" if it changed meanwhile or is not a regular file.

    Raises `OSError`.
    """
    with open(os.open(path, os.O_RDONLY | os.O_CLOEXEC | os.O_NONBLOCK), "rb") as data:
        before = os.fstat(data.fileno())
        if not stat.S_ISREG(before.st_mode):
            return "", before
        digest = hashlib.file_digest(data, "sha256").hexdigest()
        unchanged = _identity(before) == _identity(os.fstat(data.fileno()))
        return digest if unchanged else "", before


def is_same_file(path: Path, state: os.stat_result) -> bool:
    """Whether `path` is the file with `state`, with the same content as far as its times show."""
    found = path.lstat()
    return _identity(found)[:5] == _identity(state)[:5]


def write_stamp(path: Path, sha256: str) -> None:
    """Record that the file at `path` has this `sha256`; nothing is recorded where it cannot be trusted or written."""
    with suppress(OSError, FileWriteError):
        state = path.lstat()
        if _is_trusted(path, state):
            write_atomically(stamp_path(path), json.dumps({"sha256": sha256, "state": _identity(state)}).encode())


def read_stamp(path: Path) -> str:
    """The SHA-256 of the file at `path` from its stamp, without reading the file; "" without a trusted stamp."""
    with suppress(OSError, ValueError, KeyError, TypeError, RecursionError):
        state, stamp = path.lstat(), stamp_path(path)
        if not _is_trusted(path, state) or not _is_trusted(stamp, stamp.lstat()):
            return ""
        with open(os.open(stamp, _NO_FOLLOW), "rb") as data:
            if not _belongs_to_this_user(os.fstat(data.fileno())):
                return ""
            entry = json.loads(data.read(_MAX_STAMP_BYTES))
        if tuple(entry["state"]) == _identity(state) and isinstance(entry["sha256"], str):
            return entry["sha256"]
    return ""


def stamp_path(path: Path) -> Path:
    """Path of the stamp of the file at `path`."""
    return path.with_name(f".{path.name}.verified")


def _identity(state: os.stat_result) -> tuple[int, ...]:
    """Device, inode, owner, size and time of modification, and the time of the last change of the inode."""
    return (state.st_dev, state.st_ino, state.st_uid, state.st_size, state.st_mtime_ns, state.st_ctime_ns)


def _is_trusted(path: Path, state: os.stat_result) -> bool:
    """Whether only this user and root can have written the regular file at `path` or replaced it."""
    folder = path.parent.stat()
    sticky = bool(folder.st_mode & stat.S_ISVTX)  # only the owner of a file can rename or delete it
    own_folder = folder.st_uid in (os.geteuid(), _ROOT) and (sticky or not folder.st_mode & _OTHERS_MAY_WRITE)
    return stat.S_ISREG(state.st_mode) and _belongs_to_this_user(state) and own_folder


def _belongs_to_this_user(state: os.stat_result) -> bool:
    return state.st_uid in (os.geteuid(), _ROOT) and not state.st_mode & _OTHERS_MAY_WRITE
