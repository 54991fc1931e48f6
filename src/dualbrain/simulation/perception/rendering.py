"""Offscreen rendering of a plant.

The caller chooses the GL back end with the environment variable MUJOCO_GL (osmesa or egl) before MuJoCo is imported.
Shadows take most of the time of software rendering and are off by default.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from types import TracebackType
from typing import Self

import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import MissingDependencyError, UnknownNameError
from dualbrain.simulation.plant.plant import Plant

CAMERA_NAMES = ("front", "top", "side")
GL_PACKAGES = "libosmesa6 libegl1 libgl1-mesa-dri libgl1 libopengl0"
INSTALL_HINT = f"Debian: apt-get install --no-install-recommends {GL_PACKAGES}; MUJOCO_GL=osmesa or egl."


class OffscreenRenderer:
    """An offscreen GL context for one plant; close it, or use it in a `with` block."""

    def __init__(self, plant: Plant, width: int, height: int, *, shadows: bool = False) -> None:
        """Open the GL context; raises `MissingDependencyError`, which names the packages to install."""
        self._plant = plant
        self._renderer, self._option = open_renderer(plant, width, height, shadows=shadows)

    def close(self) -> None:
        """Release the GL context."""
        self._renderer.close()

    def __enter__(self) -> Self:
        """Return the renderer itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Release the GL context."""
        self.close()


class Camera(OffscreenRenderer):
    """RGB images of one plant."""

    def __init__(self, plant: Plant, *, width: int = 960, height: int = 720, shadows: bool = False) -> None:
        """Open an offscreen GL context; raises `MissingDependencyError`, which names the packages to install."""
        super().__init__(plant, width, height, shadows=shadows)

    def capture(self, view: str = "front") -> NDArray[np.uint8]:
        """The present state seen from `view` (front, top or side), an RGB array (height, width, 3).

        Raises `UnknownNameError` for another view.
        """
        if view not in CAMERA_NAMES:
            raise UnknownNameError("camera", view, CAMERA_NAMES)
        self._renderer.update_scene(self._plant.data, view, self._option)
        return self._renderer.render()


def open_renderer(
    plant: Plant, width: int, height: int, *, shadows: bool = False
) -> tuple[mujoco.Renderer, mujoco.MjvOption]:
    """An offscreen renderer for `plant` and its visualisation options.

    Raises `MissingDependencyError`, which names the packages to install.
    """
    try:
        renderer = mujoco.Renderer(plant.model, height, width)
    except Exception as error:
        raise MissingDependencyError("A GL library for offscreen rendering", fix=f"{INSTALL_HINT} ({error})") from error
    renderer.scene.flags[int(mujoco.mjtRndFlag.mjRND_SHADOW)] = int(shadows)
    renderer.scene.flags[int(mujoco.mjtRndFlag.mjRND_REFLECTION)] = 0
    option = mujoco.MjvOption()
    option.geomgroup[3] = int(not plant.has_visuals)
    return renderer, option
