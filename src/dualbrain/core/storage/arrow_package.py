"""The package that reads and writes Parquet (arro3), imported when a table is written or read."""

from __future__ import annotations

from typing import Any

from dualbrain.errors import MissingDependencyError

INSTALL_HINT = "Install it with `pip install 'dualbrain[evaluation]'`."


def import_arrow() -> tuple[Any, Any]:
    """The modules (arro3.core, arro3.io); raises `MissingDependencyError` with the install command without them."""
    try:
        from arro3 import core, io  # noqa: PLC0415  (an extra; imported when a table is written or read)
    except ModuleNotFoundError as error:
        raise MissingDependencyError("The package arro3-io, of the extra `evaluation`,", fix=INSTALL_HINT) from error
    return core, io
