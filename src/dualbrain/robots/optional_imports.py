"""Packages that only making a body needs (`world`, `bodies`); imported when first asked for, never at run time."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from dualbrain.errors import MissingDependencyError

IMPORTER_PACKAGES = ("lxml", "yourdfpy", "collada")
"""What only the reading of descriptions needs."""


def import_optional(module: str) -> Any:
    """The module called `module` ("trimesh", "scipy.spatial"), untyped.

    Raises:
        MissingPart: its package is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        group = "bodies" if package in IMPORTER_PACKAGES else "world"
        raise MissingDependencyError(
            f"The package {package}", fix=f"Install it with `pip install 'dualbrain[{group}]'`."
        ) from error
