"""Folders of dualbrain by the XDG specification: data (ledger, adapters, documents) and cache (model weights)."""

from __future__ import annotations

import os
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path

from dualbrain.core.storage.private_files import tighten
from dualbrain.core.weights import default_cache_folder


def dualbrain_home() -> Path:
    """The data folder of this process."""
    return default_home(os.environ)


def default_home(environ: Mapping[str, str]) -> Path:
    """The data folder: `$DUALBRAIN_HOME`, else `dualbrain` in the XDG data folder.

    As the XDG specification demands, `$XDG_DATA_HOME` has no effect if it is relative.
    """
    if chosen := environ.get("DUALBRAIN_HOME"):
        return Path(chosen)
    base = Path(environ.get("XDG_DATA_HOME", ""))
    home = Path(environ.get("HOME", "") or Path.home())
    return (base if base.is_absolute() else home / ".local" / "share") / "dualbrain"


def secure_home() -> None:
    """Take the permissions of other users from an existing data folder of this user (see `private_files.tighten`)."""
    with suppress(OSError):  # a read-only disk
        tighten(dualbrain_home())


def cache_folder() -> Path:
    """The cache folder for model weights."""
    return default_cache_folder(os.environ)
