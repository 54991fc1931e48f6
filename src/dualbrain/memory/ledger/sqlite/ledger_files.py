"""The files of a ledger: who may open them, and which of them are refused."""

from __future__ import annotations

from collections.abc import Generator
from contextlib import contextmanager
from pathlib import Path

from dualbrain.core.storage.atomic_files import FileWriteError
from dualbrain.core.storage.private_files import refuse_special_file, tighten
from dualbrain.errors import ConfigurationError

_SQLITE_FILES = {"-wal": "write-ahead log", "-shm": "shared index", "-journal": "rollback file"}
_OWN_FILES = {".lock": "lock file", ".anchor": "anchor file"}


@contextmanager
def translate_os_errors(path: Path) -> Generator[None]:
    """Raise `ConfigurationError` about the ledger `path` in place of an error of its files."""
    try:
        yield
    except OSError as error:
        raise unusable_ledger(error.strerror or str(error), path) from error
    except FileWriteError as error:
        raise unusable_ledger(error.reason, path) from error


def unusable_ledger(reason: str, path: Path) -> ConfigurationError:
    """The error for a ledger that cannot be read or written for this `reason`."""
    fix = "Check that this user can read and write the file, and that the disk has free space."
    return ConfigurationError.stating(f"The memory ledger {path} cannot be used: {reason}.", fix=fix)


def check_files(path: Path) -> None:
    """Raise `ConfigurationError` if the ledger or one of its other files is a link, a pipe or a folder."""
    target = path.resolve()  # SQLite puts its files beside the target of a link
    refuse_special_file(target, "memory ledger")
    for suffix, what in _SQLITE_FILES.items():
        refuse_special_file(target.with_name(target.name + suffix), f"{what} of the memory ledger")
    for suffix, what in _OWN_FILES.items():
        refuse_special_file(path.with_name(path.name + suffix), f"{what} of the memory ledger")


def tighten_files(path: Path) -> None:
    """Take the permissions of other users from existing files of the ledger."""
    target = path.resolve()
    for suffix in ("", *_SQLITE_FILES):
        tighten(target.with_name(target.name + suffix))
    for suffix in _OWN_FILES:
        tighten(path.with_name(path.name + suffix))
