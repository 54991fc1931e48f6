"""Visual meshes of the Panda, read from the optional package `example-robot-data`.

The package contains COLLADA (.dae) files, which MuJoCo does not read. This module reads the subset of COLLADA that the
files use: triangle lists, one diffuse colour per list, one rigid transform per node. MuJoCo smooths the surface.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from importlib import metadata
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

MESH_FILES = ("link0", "link1", "link2", "link3", "link4", "link5", "link6", "link7", "hand", "finger")
MESH_FOLDER = "cmeel.prefix/share/example-robot-data/robots/panda_description/meshes"
_NS = "{http://www.collada.org/2005/11/COLLADASchema}"


@dataclass(frozen=True, slots=True)
class ColouredMesh:
    """Triangles of one colour (RGB in [0, 1]): `points` (k, 3) [m] and indices into them, `faces` (t, 3)."""

    colour: tuple[float, float, float]
    points: NDArray[np.float32]
    faces: NDArray[np.int32]


def find_mesh_folder(kind: str = "visual") -> Path | None:
    """Folder of the Panda's `visual` (.dae) or `collision` (.stl) meshes; None if the package is not installed."""
    try:
        found = Path(str(metadata.distribution("example-robot-data").locate_file(MESH_FOLDER))) / kind
    except metadata.PackageNotFoundError:
        return None
    return found if found.is_dir() else None


def add_visual_meshes(robot: mujoco.MjSpec, folder: Path) -> None:
    """Add the meshes in `folder` to the robot's bodies as geoms of group 2, without collision and without mass."""
    for name in MESH_FILES:
        bodies = ("left_finger", "right_finger") if name == "finger" else (name,)
        for index, patch in enumerate(read_collada(folder / f"{name}.dae")):
            mesh = robot.add_mesh(name=f"{name}_{index}", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
            mesh.uservert, mesh.userface = patch.points.ravel(), patch.faces.ravel()
            material = _add_material(robot, patch.colour)
            for body in bodies:
                robot.body(body).add_geom(
                    type=mujoco.mjtGeom.mjGEOM_MESH,
                    meshname=mesh.name,
                    material=material,
                    group=2,
                    mass=0.0,
                    contype=0,
                    conaffinity=0,
                )


def read_collada(path: Path) -> tuple[ColouredMesh, ...]:
    """The triangles of a COLLADA file in the frame of the file, merged by colour."""
    root = ET.parse(path).getroot()
    colours, placements = _read_colours(root), _read_placements(root)
    parts: dict[tuple[float, float, float], list[ColouredMesh]] = {}
    for geometry in root.iter(f"{_NS}geometry"):
        for triangles in geometry.iter(f"{_NS}triangles"):
            colour = colours[triangles.get("material", "")]
            place = placements[geometry.get("id", "")]
            parts.setdefault(colour, []).append(_read_triangles(geometry, triangles, place, colour))
    return tuple(_merge_meshes(same) for same in parts.values())


def _read_triangles(
    geometry: ET.Element,
    triangles: ET.Element,
    place: NDArray[np.float64],
    colour: tuple[float, float, float],
) -> ColouredMesh:
    inputs = {item.get("semantic"): int(item.get("offset", "0")) for item in triangles.findall(f"{_NS}input")}
    stride = 1 + max(inputs.values())
    points = _read_positions(geometry) @ place[:3, :3].T + place[:3, 3]
    rows = np.array(triangles.findtext(f"{_NS}p", "").split(), np.int32).reshape(-1, 3, stride)
    return ColouredMesh(colour, points.astype(np.float32), rows[:, :, inputs["VERTEX"]])


def _merge_meshes(patches: list[ColouredMesh]) -> ColouredMesh:
    first = np.cumsum([0, *(len(patch.points) for patch in patches)])[:-1]
    faces = [patch.faces + start for patch, start in zip(patches, first, strict=True)]
    points = np.vstack([patch.points for patch in patches])
    return ColouredMesh(patches[0].colour, points, np.vstack(faces).astype(np.int32))


def _read_positions(geometry: ET.Element) -> NDArray[np.float64]:
    vertices = geometry.find(f".//{_NS}vertices/{_NS}input[@semantic='POSITION']")
    name = "" if vertices is None else vertices.get("source", "").lstrip("#")
    text = geometry.findtext(f".//{_NS}source[@id='{name}']/{_NS}float_array", "")
    return np.array(text.split(), np.float64).reshape(-1, 3)


def _read_colours(root: ET.Element) -> dict[str, tuple[float, float, float]]:
    """Diffuse colour of each material id."""
    diffuse = {
        effect.get("id", ""): np.array(effect.findtext(f".//{_NS}diffuse/{_NS}color", "1 1 1 1").split(), np.float64)[
            :3
        ].round(2)
        for effect in root.iter(f"{_NS}effect")
    }
    found = {}
    for material in root.iter(f"{_NS}material"):
        link = material.find(f"{_NS}instance_effect")
        red, green, blue = diffuse["" if link is None else link.get("url", "").lstrip("#")]
        found[material.get("id", "")] = (float(red), float(green), float(blue))
    return found


def _read_placements(root: ET.Element) -> dict[str, NDArray[np.float64]]:
    places = {}
    for node in root.iter(f"{_NS}node"):
        matrix = np.array(node.findtext(f"{_NS}matrix", "").split() or np.eye(4).ravel(), np.float64).reshape(4, 4)
        for instance in node.findall(f"{_NS}instance_geometry"):
            places[instance.get("url", "").lstrip("#")] = matrix
    return places


def _add_material(robot: mujoco.MjSpec, colour: tuple[float, float, float]) -> str:
    name = "shell_" + "_".join(f"{int(100 * part)}" for part in colour)
    if robot.material(name) is None:
        shade = tuple(0.86 * part + 0.02 for part in colour)
        robot.add_material(name=name, rgba=(*shade, 1.0), specular=0.4, shininess=0.5, reflectance=0.0)
    return name
