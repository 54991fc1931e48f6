"""Pictures of the world without a screen.

The caller chooses the GL back end through the environment variable MUJOCO_GL (osmesa or egl) before MuJoCo is imported.
Shadows cost most of the time in software rendering and are off unless asked for.
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
    """A GL context without a window on one plant; close it, or use it in a `with` block."""

    def __init__(self, plant: Plant, width: int, height: int, *, shadows: bool = False) -> None:
        """Open it; raises `MissingPart` with the packages to install when there is none."""
        self._plant = plant
        self._renderer, self._option = open_renderer(plant, width, height, shadows=shadows)

    def close(self) -> None:
        """Release the GL context."""
        self._renderer.close()

    def __enter__(self) -> Self:
        """Itself."""
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        """Close."""
        self.close()


class Camera(OffscreenRenderer):
    """Pictures of one plant."""

    def __init__(self, plant: Plant, *, width: int = 960, height: int = 720, shadows: bool = False) -> None:
        """Open an offscreen GL context; raises `MissingPart` with the packages to install when there is none."""
        super().__init__(plant, width, height, shadows=shadows)

    def capture(self, view: str = "front") -> NDArray[np.uint8]:
        """The world now, seen from `view` (front, top or side), as an RGB array (height, width, 3)."""
        if view not in CAMERA_NAMES:
            raise UnknownNameError("camera", view, CAMERA_NAMES)
        self._renderer.update_scene(self._plant.data, view, self._option)
        return self._renderer.render()


def open_renderer(
    plant: Plant, width: int, height: int, *, shadows: bool = False
) -> tuple[mujoco.Renderer, mujoco.MjvOption]:
    """An offscreen GL context on `plant`, and what it shows; raises `MissingPart` with the packages to install."""
    try:
        renderer = mujoco.Renderer(plant.model, height, width)
    except Exception as error:
        raise MissingDependencyError("A GL library for offscreen pictures", fix=f"{INSTALL_HINT} ({error})") from error
    renderer.scene.flags[int(mujoco.mjtRndFlag.mjRND_SHADOW)] = int(shadows)
    renderer.scene.flags[int(mujoco.mjtRndFlag.mjRND_REFLECTION)] = 0
    option = mujoco.MjvOption()
    option.geomgroup[3] = int(not plant.has_visuals)
    return renderer, option
