"""Which reader a robot's description needs, by its name and its first element."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dualbrain.robots.importer.kinematic_tree import KinematicTree


def read_description(file: Path, packages: Sequence[Path] = ()) -> KinematicTree:
    """The robot in a URDF, or in an MJCF file (root element <mujoco>).

    Raises:
        InvalidSetup: the file is hostile, not well-formed or neither of the two.
        MissingPart: a mesh or library is not there.
    """
    from dualbrain.robots.assets.safe_xml import read_xml

    root = read_xml(file)
    if root.tag in ("mujoco", "mujocoinclude"):
        from dualbrain.simulation.models.mjcf_reader import read_mjcf

        return read_mjcf(file, packages)
    from dualbrain.robots.importer.urdf import read_urdf

    return read_urdf(file, packages)
