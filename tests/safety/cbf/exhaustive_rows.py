"""Rows of all pairs in float64 numpy, to detect rows that the kernel left out.

The implementation is independent of the kernel: no culling, Jacobians by cross products, accelerations by second
differences.
"""

from dataclasses import dataclass, field

import numpy as np

from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Sphere
from dualbrain.safety.cbf.kernel import UNLIMITED_ACCELERATION, tool_frame
from tests.safety import geometry_oracle

OBSTACLE, SELF = 0, 1
ALWAYS_ROW_DISTANCE = 1e-3
"""Pairs closer than this always have a row [m]."""


@dataclass
class PairCase:
    """One case: posture, box, base, obstacles and held spheres."""

    q: np.ndarray
    low: np.ndarray
    high: np.ndarray
    obstacles: list
    age: float = 0.0
    opening: float = 0.0
    permits: dict = field(default_factory=dict)  # (link name, obstacle's index) -> contact speed [m/s]
    held: np.ndarray = field(default_factory=lambda: np.empty((0, 4)))  # in the tool frame
    held_error: float = 0.0
    base: tuple = (np.eye(3), np.zeros(3))


@dataclass
class PairRows:
    """All pairs as rows a'u >= b with their h; `permitted` pairs have a contact row instead of a barrier."""

    kind: np.ndarray
    i: np.ndarray
    j: np.ndarray
    h: np.ndarray
    a: np.ndarray
    b: np.ndarray
    permitted: np.ndarray

    def names(self):
        """(kind, i, j) of every pair."""
        return list(zip(self.kind.tolist(), self.i.tolist(), self.j.tolist(), strict=True))


class PlacedSpheres:
    """Spheres with their links and frames in one case, held spheres last."""

    def __init__(self, body, setting):
        self.setting, chain = setting, geometry_oracle.joint_frames(body, setting.q[None])
        R0, p0 = setting.base
        self.frames = [(R0 @ R[0], p0 + R0 @ p[0]) for R, p in chain]
        self.body, self.joint = body, np.arange(body.n)
        self.centre, self.radius, self.link = self._spheres(body, setting.q)
        frame_of = {link.name: link.frame for link in body.links} | {"held": body.n}
        self.frame = np.array([frame_of[name] for name in self.link])
        axes = np.array([R[:, 2] for R, _ in self.frames[1:]])
        origins = np.array([p for _, p in self.frames[1:]])
        self.jacobian = np.cross(axes[None], self.centre[:, None, :] - origins[None])  # (k, n, 3), all joints

    def second_difference(self, joints, measure):
        """Second derivative by time of `measure` of the centres if only `joints` move, at the centre of the box."""
        step, middle = 1e-4, 0.5 * (self.setting.low + self.setting.high) * joints
        ahead, behind = (self._spheres(self.body, self.setting.q + s * step * middle)[0] for s in (1, -1))
        return (measure(ahead) - 2 * measure(self.centre) + measure(behind)) / step**2

    def _spheres(self, body, q):
        R0, p0 = self.setting.base
        c, r, names = geometry_oracle.sphere_centres(body, q[None], self.setting.opening)
        held = self.setting.held
        if len(held) > 0:
            turn, offset = tool_frame(body)
            R, p = geometry_oracle.joint_frames(body, q[None])[-1]
            local = held[:, :3] @ turn.T + offset
            c = np.concatenate([c, (p[0] + local @ R[0].T)[None]], axis=1)
            r = np.concatenate([r, held[:, 3]])
            names = [*names, *["held"] * len(held)]
        return p0 + c[0] @ R0.T, r, np.array(names)


def surface_normals(shape, pose, points):
    """Outward unit normals (k, 3): the gradient of the distance."""
    R = geometry_oracle.rotation_matrix(pose.quaternion)
    local = (points - np.array(pose.position)) @ R
    match shape:
        case Sphere():
            away = local
        case Capsule(half_length=h):
            away = local - np.stack([0 * local[:, 0], 0 * local[:, 0], np.clip(local[:, 2], -h, h)], axis=1)
        case Box(half_extents=e):
            away = local - np.clip(local, -np.array(e), np.array(e))
            face = np.argmax(np.abs(local) - np.array(e), axis=1)
            out = np.eye(3)[face] * np.where(local >= 0.0, 1.0, -1.0)
            away = np.where(np.linalg.norm(away, axis=1, keepdims=True) < 1e-9, out, away)
        case HalfSpace():
            away = np.tile([0.0, 0.0, 1.0], (len(points), 1))
    return (away / np.linalg.norm(away, axis=1, keepdims=True)) @ R.T


def all_pair_rows(body, config, setting):
    """Rows of all pairs that must keep apart or may touch."""
    spheres, parts = PlacedSpheres(body, setting), []
    for j, obstacle in enumerate(setting.obstacles):
        parts.append(_obstacle_rows(body, config, spheres, j, obstacle))
    kept = [sorted(pair, key=lambda name: _frame(body, name)) for pair in body.self_pairs.kept]
    for near, far in kept:
        parts += _self_collision_rows(body, config, spheres, near, far, 0.0)
    if len(setting.held) > 0:
        gripper = {link.name for link in body.links if link.group in ("hand", "fingers")}
        for near in dict.fromkeys(near for near, far in kept if far in gripper):
            parts += _self_collision_rows(body, config, spheres, near, "held", setting.held_error)
    return PairRows(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def _frame(body, name):
    return next(link.frame for link in body.links if link.name == name)


def _obstacle_rows(body, config, spheres, j, obstacle):
    """Rows of one obstacle and all moving spheres that it applies to."""
    setting = spheres.setting
    known = {link.name for link in body.links if not obstacle.parts or {link.name, link.group} & set(obstacle.parts)}
    known |= {"held"} if not obstacle.parts or "held" in obstacle.parts else set()
    mine = np.flatnonzero((spheres.frame > 0) & np.isin(spheres.link, list(known)))
    v = np.array(obstacle.velocity)
    points = spheres.centre[mine] - v * setting.age
    n = surface_normals(obstacle.shape, obstacle.pose, points)
    margin = obstacle.margin + obstacle.velocity_error * setting.age + config.sampling_margin + config.rounding_margin
    margin = margin + np.where(spheres.link[mine] == "held", setting.held_error, 0.0)
    h = geometry_oracle.surface_distance(obstacle.shape, obstacle.pose, points) - spheres.radius[mine] - margin
    moves = spheres.joint[None] < spheres.frame[mine][:, None]
    a = np.einsum("skx,sx->sk", spheres.jacobian[mine], n) * moves
    permit = np.array([setting.permits.get((name, j), -1.0) for name in spheres.link[mine]])
    cap = np.where(permit >= 0.0, -permit, config.recovery_speed)
    alpha = obstacle.alpha or body.alpha
    acceleration = spheres.second_difference(spheres.joint >= 0, lambda centre: centre[mine])
    deceleration = np.maximum(0.0, -np.einsum("sx,sx->s", n, acceleration))
    bend = 0.5 * body.period * deceleration
    b = (
        np.minimum(-approach_speed(body, config, alpha, h, deceleration), cap)
        + n @ v
        + np.where(permit >= 0.0, 0.0, obstacle.velocity_error)
    )
    b = b + bend + _tracking_term(config, a)
    kind = np.full(len(mine), OBSTACLE)
    return kind, mine, np.full(len(mine), j), h, a, b, permit >= 0.0


def approach_speed(body, config, alpha, h, deceleration):
    """Largest rates at which h may fall: alpha h, and at h ≥ 0 those after which a stop along the path ends there."""
    limited = config.acceleration_limits
    most = [joint.acceleration.value if limited else UNLIMITED_ACCELERATION for joint in body.joints]
    advance = 0.5 * max(joint.velocity.value / a for joint, a in zip(body.joints, most, strict=True))
    return np.minimum(alpha * h, np.maximum((h - 0.5 * deceleration * advance**2) / advance, 0.0))


def _tracking_term(config, a):
    return np.abs(a) @ np.broadcast_to(config.tracking_error, a.shape[1])


def _self_collision_rows(body, config, spheres, near, far, error):
    """All pairs of spheres of two links; row i is the far sphere."""
    s, i = np.flatnonzero(spheres.link == far), np.flatnonzero(spheres.link == near)
    if len(s) == 0 or len(i) == 0 or spheres.frame[s[0]] == spheres.frame[i[0]]:
        return []
    s, i = (grid.ravel() for grid in np.meshgrid(s, i, indexing="ij"))
    away = spheres.centre[s] - spheres.centre[i]
    d = np.linalg.norm(away, axis=1)
    n = away / d[:, None]
    h = d - spheres.radius[s] - spheres.radius[i] - config.self_margin - config.sampling_margin
    h = h - config.rounding_margin - error
    between = (spheres.joint[None] < spheres.frame[s][:, None]) & (spheres.joint[None] >= spheres.frame[i][:, None])
    a = np.einsum("skx,sx->sk", spheres.jacobian[s], n) * between
    bend = spheres.second_difference(between[0], lambda centre: np.linalg.norm(centre[s] - centre[i], axis=1))
    deceleration = np.maximum(0.0, -bend)
    allowed = approach_speed(body, config, config.alpha_self or body.alpha, h, deceleration)
    b = np.minimum(-allowed, config.recovery_speed) + 0.5 * body.period * deceleration
    b = b + _tracking_term(config, a)
    return [(np.full(len(s), SELF), s, i, h, a, b, np.zeros(len(s), bool))]
