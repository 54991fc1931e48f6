"""Choice of the GL library for rendering, before MuJoCo is imported: its import fails if the library is missing."""

from __future__ import annotations

from collections.abc import MutableMapping
from ctypes.util import find_library

GL_LIBRARIES = {"egl": ("EGL", "GL"), "osmesa": ("OSMesa", "GL"), "glfw": ("GL",), "glx": ("GL",)}
"""Values of MUJOCO_GL and the shared libraries behind them."""
DISABLED_VALUES = ("disable", "disabled", "off", "false", "0")


def choose_graphics(environ: MutableMapping[str, str]) -> str:
    """Set a usable MUJOCO_GL in `environ` (default egl), or `disable`; returns the reason if there is none, else ""."""
    wanted = environ.get("MUJOCO_GL", "").lower().strip() or "egl"
    environ["MUJOCO_GL"] = wanted
    if wanted in DISABLED_VALUES:
        return f"MUJOCO_GL={wanted}"
    missing = [f"lib{name}" for name in GL_LIBRARIES.get(wanted, ()) if not find_library(name)]
    if wanted in GL_LIBRARIES and not missing:
        return ""
    environ["MUJOCO_GL"] = "disable"
    if missing:
        return f"MUJOCO_GL={wanted} needs {', '.join(missing)}"
    return f"MUJOCO_GL={wanted} is not one of {', '.join(GL_LIBRARIES)}"
