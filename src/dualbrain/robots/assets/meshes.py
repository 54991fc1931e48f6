"""Triangle meshes of robots from installed data packages. Needs the extra `simulation`; not used at run time."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.errors import MissingDependencyError, UnknownNameError
from dualbrain.robots.model import Quaternion, Vector
from dualbrain.robots.optional_imports import import_optional

Array = NDArray[np.float64]

DESCRIPTION_PACKAGE = "example-robot-data"
DESCRIPTION_FOLDERS = {"panda": "panda_description"}
INSTALL_HINT = f"Install it with `pip install --no-deps {DESCRIPTION_PACKAGE}` (only its data files are used)."


@dataclass(frozen=True, slots=True)
class Mesh:
    """A triangle mesh: `vertices` (v, 3) in metres in its link frame, `faces` (f, 3) as indices into them."""

    vertices: Array
    faces: NDArray[np.int64]

    @property
    def triangles(self) -> Array:
        """Corners of every face, (f, 3, 3)."""
        return self.vertices[self.faces]

    @property
    def areas(self) -> Array:
        """Area of every face [m²], (f,)."""
        a, b, c = np.moveaxis(self.triangles, 1, 0)
        return 0.5 * np.linalg.norm(np.cross(b - a, c - a), axis=1)


def description_folder(robot: str) -> Path:
    """Folder of the description of `robot` (urdf/, meshes/) in the installed package `example-robot-data`.

    The package installs its data outside the importable package, so the folder is found through the list of files in
    the metadata.

    Raises:
        UnknownNameError: No description is known for `robot`.
        MissingDependencyError: The package, or the folder of the robot in it, is not installed.
    """
    if robot not in DESCRIPTION_FOLDERS:
        raise UnknownNameError("robot description", robot, tuple(DESCRIPTION_FOLDERS), owner=DESCRIPTION_PACKAGE)
    folder_parts = ("robots", DESCRIPTION_FOLDERS[robot])
    try:
        files = metadata.files(DESCRIPTION_PACKAGE) or []
    except metadata.PackageNotFoundError as error:
        raise MissingDependencyError(f"The package {DESCRIPTION_PACKAGE}", fix=INSTALL_HINT) from error
    for file in files:
        for depth in range(len(file.parts) - 2):
            if file.parts[depth : depth + 2] == folder_parts:
                folder = Path(str(file.locate())).parents[len(file.parts) - depth - 3]
                if folder.is_dir():
                    return folder
    raise MissingDependencyError(f"The description of {robot!r} in {DESCRIPTION_PACKAGE}", fix=INSTALL_HINT)


def mesh_path(robot: str, kind: str, name: str) -> Path:
    """Path of one mesh file; `kind` is "collision" (STL) or "visual" (DAE), `name` has no suffix.

    Raises:
        MissingDependencyError: The file does not exist.
    """
    suffix = {"collision": ".stl", "visual": ".dae"}.get(kind, "")
    path = description_folder(robot) / "meshes" / kind / f"{name}{suffix}"
    if not path.is_file():
        raise MissingDependencyError(f"The {kind} mesh {name!r} of {robot!r}", fix=INSTALL_HINT)
    return path


def read_mesh(path: Path) -> Mesh:
    """The mesh in the file `path` with equal vertices merged.

    Raises:
        MissingDependencyError: trimesh is not installed.
    """
    loaded = import_optional("trimesh").load_mesh(str(path), process=True)
    return Mesh(np.asarray(loaded.vertices, dtype=np.float64), np.asarray(loaded.faces, dtype=np.int64))


def collision_mesh(robot: str, name: str) -> Mesh:
    """The collision mesh `name` ("link3", "hand", "finger") of `robot`."""
    return read_mesh(mesh_path(robot, "collision", name))


def package_mesh(package: str, file: str) -> Mesh:
    """The mesh in `file`, a path inside the installed `package`, which is not imported.

    Raises:
        MissingDependencyError: The package, or the file in it, is not installed.
    """
    fix = f"Install it with `pip install --no-deps {package}` (only its data files are used)."
    try:
        path = Path(str(metadata.distribution(package).locate_file(file)))
    except metadata.PackageNotFoundError as error:
        raise MissingDependencyError(f"The package {package}", fix=fix) from error
    if not path.is_file():
        raise MissingDependencyError(f"The file {file!r} of {package}", fix=fix)
    return read_mesh(path)


def transform_mesh(mesh: Mesh, translation: Vector, quaternion: Quaternion) -> Mesh:
    """`mesh` rotated by `quaternion` (w, x, y, z), then shifted by `translation` [m]."""
    return Mesh(mesh.vertices @ quaternion_to_matrix(quaternion).T + np.array(translation), mesh.faces)


def convex_hull_mesh(points: Array) -> Mesh:
    """The convex hull of `points` (p, 3) with outward faces."""
    hull = import_optional("trimesh").Trimesh(vertices=points).convex_hull
    return Mesh(np.asarray(hull.vertices, dtype=np.float64), np.asarray(hull.faces, dtype=np.int64))
