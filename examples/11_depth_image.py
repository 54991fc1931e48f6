"""A depth image becomes shapes that the filter keeps away from: back-projected, without the table, clustered, covered.

The camera stands beside the robot. What it does not know is passed on as a bound: depth noise, calibration, age.
"""

from __future__ import annotations

import numpy as np
from scipy.sparse.csgraph import connected_components
from scipy.spatial import cKDTree

from dualbrain.core.geometry.distance import signed_distance
from dualbrain.core.geometry.rotations import quaternion_to_matrix
from dualbrain.core.geometry.shapes import Box, HalfSpace, Pose, Sphere
from dualbrain.robots.loader import load_robot
from dualbrain.safety.barriers.scenarios import EXACT_TRACKING
from dualbrain.safety.cbf.filter import Obstacle, SafetyFilter
from dualbrain.safety.integration.scene_fusion import (
    FrameMount,
    PerceivedShape,
    SceneFusion,
    SceneSource,
    SourceAccepted,
    SourceRefused,
)

WIDTH, HEIGHT, FOCAL = 96, 72, 80.0
"""Pixels, and the focal length in pixels."""
NOISE = 0.004
"""Bound of the depth error [m]."""
LOOK = Pose((1.35, 0.0, 0.75), (0.2706, -0.6533, -0.6533, 0.2706))
"""Camera in the world: z forward and 45 degrees down, toward the robot; x to its right."""
TABLE = (HalfSpace(), Pose((0.0, 0.0, 0.0)))
POST, BALL = (Box((0.03, 0.03, 0.2)), Pose((0.5, 0.15, 0.2))), (Sphere(0.06), Pose((0.55, -0.2, 0.06)))
"""The truth, which only the camera and the last line know."""


def true_depth():
    """The depth [m] along every pixel's ray (here: against a post and a ball on a table)."""
    rays = pixel_rays() @ quaternion_to_matrix(LOOK.quaternion).T
    depth = np.full(len(rays), 0.2)
    for _ in range(80):  # sphere tracing: as far as nothing is nearer
        points = np.array(LOOK.position) + rays * depth[:, None]
        depth += 0.95 * np.min([signed_distance(*thing, points) for thing in (TABLE, POST, BALL)], axis=0)
    return depth


def picture(depth, rng):
    """A depth image [m] as a sensor would give it: no two are alike, and a source that repeats itself is refused."""
    return (depth + rng.uniform(-NOISE, NOISE, len(depth))).reshape(HEIGHT, WIDTH)


def pixel_rays():
    """Direction (pixels, 3) of every pixel's ray in the camera's frame, of unit length."""
    x, y = np.meshgrid(np.arange(WIDTH) - WIDTH / 2 + 0.5, np.arange(HEIGHT) - HEIGHT / 2 + 0.5)
    rays = np.column_stack([x.ravel(), y.ravel(), np.full(x.size, FOCAL)])
    return rays / np.linalg.norm(rays, axis=1, keepdims=True)


def primitives(depth, camera):
    """Clusters of what stands off the table, each in a ball around it; in the camera's frame."""
    points = pixel_rays() * depth.reshape(-1, 1)
    height = points @ quaternion_to_matrix(camera.quaternion)[2] + camera.position[2]
    points = points[(height > 0.015) & (depth.ravel() < 2.0)]
    pairs = cKDTree(points).sparse_distance_matrix(cKDTree(points), 0.035)
    count, label = connected_components(pairs)
    clusters = [points[label == k] for k in range(count) if np.sum(label == k) >= 8]
    return [ball for k, cluster in enumerate(clusters) for ball in balls(f"cluster{k}", cluster)]


def balls(name, points, most=0.05):
    """Balls that contain the points: cut across the longest side until they are small."""
    middle = 0.5 * (points.min(axis=0) + points.max(axis=0))
    radius = float(np.linalg.norm(points - middle, axis=1).max())
    if radius <= most:
        return [PerceivedShape(name=name, shape=Sphere(radius + 0.02), pose=Pose(tuple(middle.tolist())))]
    axis = np.linalg.svd(points - middle, full_matrices=False)[2][0]
    left = (points - middle) @ axis < 0.0
    return balls(f"{name}a", points[left], most) + balls(f"{name}b", points[~left], most)


rng = np.random.default_rng(0)
feed = SceneFusion(
    {"camera": SceneSource(error=NOISE, max_age=0.2)}, {"lens": FrameMount(pose=LOOK, error=0.002, angle_error=0.002)}
)
depth = true_depth()
shapes = primitives(picture(depth, rng), LOOK)
for frame, stamp in (("lens", 0.0), ("lense", 0.0), ("lens", -1.0)):
    match feed.update("camera", frame, stamp, shapes, now=0.0):
        case SourceAccepted(_, count):
            print(f"{count} balls from one depth image")
        case SourceRefused(_, reason):
            print(f"refused: {reason}")
safety = SafetyFilter(load_robot("panda"), EXACT_TRACKING, obstacles=[Obstacle("table", *TABLE)])
q, u, least = np.array(safety.robot_model.home), np.zeros(7), np.inf
for tick in range(1500):
    now = 1e-3 * tick
    if tick % 50 == 0 and tick < 1000:
        feed.update("camera", "lens", now, primitives(picture(depth, rng), LOOK), now=now)
    feed.apply_to(safety, now)
    answer = safety(q, u, np.array([0.3, 0.6, 0.0, 0.3, 0.0, 0.0, 0.0]), now)
    q, u = q + 1e-3 * answer.u, answer.u
    where, radii, _ = safety.spheres(q, 0.0)
    least = min(least, *(float((signed_distance(*thing, where) - radii).min()) for thing in (POST, BALL)))
    if tick in (200, 999, 1499):
        print(f"{now:.1f} s: {answer.explain()}; |u| {np.linalg.norm(u):.3f} rad/s")
print(f"nothing true came nearer than {least * 1e3:.1f} mm")
