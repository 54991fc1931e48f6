"""From a depth image to obstacles of the filter: back-projection, removal of the table, clusters, covering spheres.

Run: `python examples/07_depth_image.py`. Needs scipy (`pip install 'dualbrain[simulation]'`). The camera is mounted
beside the robot. Its uncertainties are passed on as bounds: depth noise, calibration error, age.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree
from scipy.spatial.transform import Rotation

import dualbrain.safety as ds
from dualbrain import Box, HalfSpace, Obstacle, Pose, SafetyFilter, Sphere, load_robot

WIDTH, HEIGHT, FOCAL = 96, 72, 80.0
"""Image size and focal length [pixels]."""
NOISE = 0.004
"""Bound of the depth error [m]."""
CAMERA = Pose((1.35, 0.0, 0.75), (0.2706, -0.6533, -0.6533, 0.2706))
"""Pose of the camera in the world: z points forward and 45° down toward the robot, x to its right."""
CAMERA_ROTATION = Rotation.from_quat(np.roll(CAMERA.quaternion, -1)).as_matrix()
TABLE = (HalfSpace(), Pose((0.0, 0.0, 0.0)))
POST, BALL = (Box((0.03, 0.03, 0.2)), Pose((0.5, 0.15, 0.2))), (Sphere(0.06), Pose((0.55, -0.2, 0.06)))
"""Ground truth: known only to the simulated camera and to the final check."""


def true_depth():
    """The depth [m] along the ray of every pixel, by sphere tracing."""
    rays = pixel_rays() @ CAMERA_ROTATION.T
    depth = np.full(len(rays), 0.2)
    for _ in range(80):
        points = np.array(CAMERA.position) + rays * depth[:, None]
        depth += 0.95 * np.min([ds.signed_distance(*obj, points) for obj in (TABLE, POST, BALL)], axis=0)
    return depth


def take_image(depth, rng):
    """A noisy depth image [m]; images differ, because the fusion refuses a source that repeats its data."""
    return (depth + rng.uniform(-NOISE, NOISE, len(depth))).reshape(HEIGHT, WIDTH)


def pixel_rays():
    """Unit direction (pixels, 3) of the ray of every pixel, in the camera frame."""
    x, y = np.meshgrid(np.arange(WIDTH) - WIDTH / 2 + 0.5, np.arange(HEIGHT) - HEIGHT / 2 + 0.5)
    rays = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, FOCAL)])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def covering_spheres(depth):
    """Spheres around the clusters of points above the table, in the camera frame."""
    points = pixel_rays() * depth.reshape(-1, 1)
    height = points @ CAMERA_ROTATION[2] + CAMERA.position[2]
    points = points[(height > 0.015) & (depth.ravel() < 2.0)]
    pairs = cKDTree(points).sparse_distance_matrix(cKDTree(points), 0.035)
    count, label = connected_components(pairs)
    clusters = [points[label == k] for k in range(count) if np.sum(label == k) >= 8]
    return [sphere for k, cluster in enumerate(clusters) for sphere in split_spheres(f"cluster{k}", cluster)]


def split_spheres(name, points, max_radius=0.05):
    """Spheres that contain the points; large clusters are split across their longest axis."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = float(np.linalg.norm(points - middle, axis=1).max())
    if radius <= max_radius:
        return [ds.PerceivedShape(name=name, shape=Sphere(radius + 0.02), pose=Pose(tuple(middle.tolist())))]
    axis = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    left = (points - middle) @ axis < 0.0
    return split_spheres(f"{name}a", points[left]) + split_spheres(f"{name}b", points[~left])


rng = np.random.default_rng(0)
fusion = ds.SceneFusion(
    {"camera": ds.SceneSource(error=NOISE, max_age=0.2)},
    {"lens": ds.FrameMount(pose=CAMERA, error=0.002, angle_error=0.002)},
)
depth = true_depth()
shapes = covering_spheres(take_image(depth, rng))
for frame, stamp in (("lens", 0.0), ("lense", 0.0), ("lens", -1.0)):
    match fusion.update("camera", frame, stamp, shapes, now=0.0):
        case ds.SourceAccepted(_, count):
            print(f"{count} spheres from one depth image")
        case ds.SourceRefused(_, reason):
            print(f"refused: {reason}")
safety = SafetyFilter(load_robot("panda"), ds.EXACT_TRACKING, obstacles=[Obstacle("table", *TABLE)])
q, u, least = np.array(safety.robot_model.home), np.zeros(7), np.inf
for tick in range(1500):
    now = 1e-3 * tick
    if tick % 50 == 0 and tick < 1000:
        fusion.update("camera", "lens", now, covering_spheres(take_image(depth, rng)), now=now)
    fusion.apply_to(safety, now)
    result = safety(q, u, np.array([0.3, 0.6, 0.0, 0.3, 0.0, 0.0, 0.0]), now)
    q, u = q + 1e-3 * result.u, result.u
    centres, radii, _ = safety.spheres(q, 0.0)
    least = min(least, *(float((ds.signed_distance(*obj, centres) - radii).min()) for obj in (POST, BALL)))
    if tick in (200, 999, 1499):
        print(f"{now:.1f} s: {result.explain()}; |u| {np.linalg.norm(u):.3f} rad/s")
print(f"minimum true clearance {least * 1e3:.1f} mm")
