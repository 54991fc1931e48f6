"""A mesh that contains a body at every value of the joints that move it, for fingers and other swept links.

The ranges of the joints are divided into cells. A joint that turns by δ in a cell moves a point on an arc, which is in
the triangle of its ends and of the intersection of their tangents: the point at the middle of the cell, with its
distance from the axis enlarged by 1 / cos(δ/2). A prismatic joint moves it on the segment between the ends. All corners
are affine in the point, so for several joints in a row the hull of the body at all corners of a cell contains the body
at every value in the cell.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.assets.mesh_primitives import apply_pose, concatenate_meshes, thickened_hull_mesh
from dualbrain.robots.assets.meshes import Mesh
from dualbrain.robots.collision_model.convex_decomposition import decompose_convex

Array = NDArray[np.float64]


def arc_enlargement(axis: Array, angle: float) -> Array:
    """Scaling (4, 4) of the distance from the line along the unit `axis` (3,) by 1 / cos(angle/2); `angle` in rad."""
    scaling = np.eye(4)
    along = np.outer(axis, axis)
    scaling[:3, :3] = along + (np.eye(3) - along) / np.cos(0.5 * angle)
    return scaling


def swept_mesh(mesh: Mesh, cells: Array) -> Mesh:
    """The hulls of the convex parts of `mesh` over every cell; `cells` (cells, corners, 4, 4) are affine transforms."""
    hulls = [
        thickened_hull_mesh(np.vstack([apply_pose(part, corner).vertices for corner in cell]))
        for part in decompose_convex(mesh)
        for cell in cells
    ]
    return concatenate_meshes(hulls)
