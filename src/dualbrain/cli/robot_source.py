"""Which reader a robot's description needs, by its name and its first element."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dualbrain.embodiment.description.tree import Tree


def read_description(file: Path, packages: Sequence[Path] = ()) -> Tree:
    """The robot in a URDF, or in an MJCF file (root element <mujoco>).

    Raises:
        InvalidSetup: the file is hostile, not well-formed or neither of the two.
        MissingPart: a mesh or library is not there.
    """
    from dualbrain.embodiment.description.safe_xml import read_xml

    _, root = read_xml(file)
    if root.tag in ("mujoco", "mujocoinclude"):
        from dualbrain.world.mjcf import read_mjcf

        return read_mjcf(file, packages)
    from dualbrain.embodiment.description.urdf import read_urdf

    return read_urdf(file, packages)
