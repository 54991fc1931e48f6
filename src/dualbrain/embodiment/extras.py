"""Packages of the `world` extra that only the generator needs; imported when first asked for, never at run time."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from dualbrain.errors import MissingPart


def extra(module: str) -> Any:
    """The module called `module` ("trimesh", "scipy.spatial"), untyped.

    Raises:
        MissingPart: its package is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        raise MissingPart(f"The package {package}", fix="Install it with `pip install 'dualbrain[world]'`.") from error
