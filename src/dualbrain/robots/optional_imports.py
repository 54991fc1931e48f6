"""Lazy imports of packages that only the making of a robot model needs (extras `simulation` and `import`)."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from dualbrain.errors import MissingDependencyError

IMPORTER_PACKAGES = ("lxml", "yourdfpy", "collada")
"""Packages of the extra `import`, which only the readers of robot descriptions need."""


def import_optional(module: str) -> Any:
    """The module called `module` ("trimesh", "scipy.spatial"), untyped.

    Raises:
        MissingDependencyError: The package is not installed.
    """
    try:
        return import_module(module)
    except ImportError as error:
        package = module.partition(".")[0]
        extra = "import" if package in IMPORTER_PACKAGES else "simulation"
        raise MissingDependencyError(
            f"The package {package}", fix=f"Install it with `pip install 'dualbrain[{extra}]'`."
        ) from error
