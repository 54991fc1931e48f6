"""Read a robot description; its root element determines the format."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from dualbrain.robots.importer.kinematic_tree import KinematicTree


def read_description(file: Path, packages: Sequence[Path] = ()) -> KinematicTree:
    """The kinematic tree of a URDF file or of an MJCF file (root element <mujoco>).

    Raises:
        ConfigurationError: The file is unsafe, not well-formed, or neither URDF nor MJCF.
        MissingDependencyError: A mesh or library is missing.
    """
    from dualbrain.robots.assets.safe_xml import root_tag

    if root_tag(file) in ("mujoco", "mujocoinclude"):
        from dualbrain.simulation.models.mjcf_reader import read_mjcf

        return read_mjcf(file, packages)
    from dualbrain.robots.importer.urdf import read_urdf

    return read_urdf(file, packages)
