"""Folders of dualbrain by the XDG specification: data (ledger, adapters, documents) and cache (model weights)."""

from __future__ import annotations

import os
from contextlib import suppress
from pathlib import Path

from dualbrain.core.storage.private_files import tighten
from dualbrain.core.weights import default_cache_folder


def dualbrain_home() -> Path:
    """The data folder: `$DUALBRAIN_HOME`, else `dualbrain` in the XDG data folder."""
    if chosen := os.environ.get("DUALBRAIN_HOME"):
        return Path(chosen)
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "dualbrain"


def secure_home() -> None:
    """Take the permissions of other users from an existing data folder of this user (see `private_files.tighten`)."""
    with suppress(OSError):  # a read-only disk
        tighten(dualbrain_home())


def cache_folder() -> Path:
    """The cache folder for model weights."""
    return default_cache_folder(os.environ)
