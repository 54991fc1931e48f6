"""Where dualbrain keeps things: ledger and adapters in its home, weights in a cache; both by the XDG rules."""

from __future__ import annotations

import os
from pathlib import Path

from dualbrain.core.weights import default_cache_folder


def dualbrain_home() -> Path:
    """`$DUALBRAIN_HOME`, else the XDG data folder."""
    if chosen := os.environ.get("DUALBRAIN_HOME"):
        return Path(chosen)
    return Path(os.environ.get("XDG_DATA_HOME") or Path.home() / ".local" / "share") / "dualbrain"


def cache_folder() -> Path:
    """The XDG cache folder for model weights."""
    return default_cache_folder(os.environ)
