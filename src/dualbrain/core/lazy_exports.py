"""Lazy exports of a package (PEP 562): a public name is imported from its module on first use."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from importlib import import_module
from typing import Any

EXTRAS = {
    "PIL": "planner",
    "accelerate": "adapt",
    "anyio": "mcp",
    "arro3": "evaluation",
    "bitsandbytes": "qlora",
    "casadi": "symbolic",
    "collada": "import",
    "cyclonedds": "ros2",
    "cyclonedx_py": "evidence",
    "cyclopts": "cli",
    "example_robot_data": "simulation",
    "gguf": "planner",
    "gymnasium": "gym",
    "httpx": "planner",
    "huggingface_hub": "adapt",
    "llguidance": "planner",
    "lxml": "import",
    "matplotlib": "view",
    "mcap": "view",
    "mcp": "mcp",
    "mujoco": "simulation",
    "onnxruntime": "memory",
    "opentelemetry": "trace",
    "peft": "adapt",
    "prometheus_client": "metrics",
    "pylibfranka": "franka",
    "pymilvus": "milvus",
    "pypdf": "knowledge",
    "ray": "ray",
    "rich": "cli",
    "rtde_control": "ur",
    "safetensors": "planner",
    "scipy": "simulation",
    "selectolax": "knowledge",
    "starlette": "mcp",
    "statsmodels": "evaluation",
    "tokenizers": "memory",
    "torch": "adapt",
    "transformers": "adapt",
    "trimesh": "simulation",
    "uvicorn": "mcp",
    "viser": "view",
    "xllamacpp": "planner",
    "yaml": "ros2",
    "yourdfpy": "import",
}
"""The extra that installs each optional module."""


def lazy_exports(
    package: str, modules: Mapping[str, tuple[str, ...]]
) -> tuple[Callable[[str], Any], Callable[[], list[str]]]:
    """The functions `__getattr__` and `__dir__` of `package`, whose public `modules` map a module to its names.

    Raises `MissingDependencyError` with the install command when a name needs a package that is not installed.
    """
    sources = {name: module for module, names in modules.items() for name in names}

    def get(name: str) -> Any:
        source = sources.get(name)
        if source is None:
            raise AttributeError(f"module {package!r} has no attribute {name!r}")
        try:
            value = getattr(import_module(f"dualbrain.{source}"), name)
        except ModuleNotFoundError as error:
            raise missing_dependency(error, f"{package}.{name}") from error
        setattr(sys.modules[package], name, value)
        return value

    def names() -> list[str]:
        return sorted({*sources, *vars(sys.modules[package])})

    return get, names


def missing_dependency(error: ModuleNotFoundError, needed_by: str) -> Exception:
    """The error for a module that `needed_by` needs: with the install command if an extra provides it, else `error`."""
    from dualbrain.errors import MissingDependencyError  # noqa: PLC0415  (only where something is missing)

    extra = EXTRAS.get((error.name or "").partition(".")[0])
    if extra is None:
        return error
    fix = f"Install it with `pip install 'dualbrain[{extra}]'`."
    return MissingDependencyError(f"The package {error.name}, which {needed_by} needs,", fix=fix)
