"""Depth images of axis-aligned boxes, by intersecting the ray of each pixel with them: an oracle without a renderer."""

import numpy as np

from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.safety.integration.point_clouds.pinhole_camera import PinholeCamera

CAMERA = PinholeCamera(width=80, height=60, fx=60.0, fy=60.0, cx=39.5, cy=29.5)


def render_depth(boxes, pose, camera=CAMERA):
    """Depth (height, width) [m] of `boxes` (pairs of corners (3,) [m]) seen from `pose`; 0 where nothing is."""
    rows, columns = np.mgrid[: camera.height, : camera.width]
    local = np.stack([(columns - camera.cx) / camera.fx, (rows - camera.cy) / camera.fy, np.ones_like(rows)], axis=-1)
    ways = local @ quaternion_to_matrix(pose.quaternion).T
    with np.errstate(divide="ignore"):
        scale = 1.0 / ways
    depth = np.full(rows.shape, np.inf)
    for low, high in boxes:
        ends = np.stack([(np.asarray(corner) - pose.position) * scale for corner in (low, high)])
        enter, leave = ends.min(axis=0).max(axis=-1), ends.max(axis=0).min(axis=-1)
        depth = np.where((enter <= leave) & (enter > 0.0), np.minimum(depth, enter), depth)
    return np.where(np.isfinite(depth), depth, 0.0)
