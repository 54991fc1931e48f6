"""Rows of the filter in numpy and float64, directly from the equations and for every pair.

    n'J u >= min(-s, recovery) + n'v_o + velocity_error + tracking sum_k |n'J_k| + max(0, -dt/2 n'a)

where h includes its margins, s is `approach_speed`, and a is the second derivative of the centre along the centre of
the box, both by finite differences; for two links n'a is the second derivative of the distance. Contact permits replace
the barrier by -max(speed, s); speed and separation adds the tighter of both.
"""

from dataclasses import dataclass, field

import numpy as np

from dualbrain.safety.cbf.filter import Contact, FilterConfig, Obstacle
from tests.safety import geometry_oracle

DIFFERENCE_STEP = 1e-6


@dataclass
class FilterCase:
    """All inputs of the filter."""

    robot_model: object
    config: FilterConfig
    obstacles: list[Obstacle]
    permits: list[Contact] = field(default_factory=list)
    held: np.ndarray = field(default_factory=lambda: np.empty((0, 4)))
    held_error: float = 0.0
    rows: list = field(default_factory=list)
    opening: float = 0.0
    age: float = 0.0
    extra: float = 0.0
    known_only: bool = False


def joint_frames(body, q):
    """Rotation and origin of frames 0..n, with revolute and prismatic joints about or along z."""
    R, p = np.eye(3), np.zeros(3)
    out = [(R, p)]
    for joint, value in zip(body.joints, q, strict=True):
        p = p + R @ np.array(joint.translation)
        R = R @ geometry_oracle.rotation_matrix(joint.quaternion)
        if joint.kind == "prismatic":
            p = p + R[:, 2] * value
        else:
            c, s = np.cos(value), np.sin(value)
            R = R @ np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
        out.append((R, p))
    return out


def tool_pose(body, q):
    """Position and rotation of the tool."""
    link = next(link for link in body.links if link.name == body.tool.link)
    R, p = joint_frames(body, q)[link.frame]
    p, R = p + R @ np.array(link.translation), R @ geometry_oracle.rotation_matrix(link.quaternion)
    return p + R @ np.array(body.tool.translation), R @ geometry_oracle.rotation_matrix(body.tool.quaternion)


def sphere_centres(s, q):
    """Centres (k, 3) of the spheres in the order of the links, held spheres last."""
    chain, points = joint_frames(s.robot_model, q), []
    for link in s.robot_model.links:
        R, p = chain[link.frame]
        R, p = R @ geometry_oracle.rotation_matrix(link.quaternion), p + R @ np.array(link.translation)
        points += [
            p + R @ (np.array(sphere.centre) + s.opening * np.array(link.slide))
            for sphere in s.robot_model.spheres
            if sphere.link == link.name
        ]
    p, R = tool_pose(s.robot_model, q)
    return np.array([*points, *(p + s.held[:, :3] @ R.T)])


def sphere_owners(s):
    """Link index of every sphere (len(links) for held spheres), its radius, and its frame."""
    link, radius = [], []
    for index, part in enumerate(s.robot_model.links):
        radii = [sphere.radius for sphere in s.robot_model.spheres if sphere.link == part.name]
        link += [index] * len(radii)
        radius += radii
    link += [len(s.robot_model.links)] * len(s.held)
    frame = np.array([*(part.frame for part in s.robot_model.links), s.robot_model.n])[link]
    return np.array(link), np.array([*radius, *s.held[:, 3]]), frame


def control_bounds(s, q, u_prev):
    """Velocity limit, acceleration around u_prev, and joint position: min(alpha d, discrete braking)."""
    c, dt = s.config, s.robot_model.period
    low, high = np.empty(s.robot_model.n), np.empty(s.robot_model.n)
    for k, joint in enumerate(s.robot_model.joints):
        v, a = joint.velocity.value, joint.acceleration.value
        floor, ceiling = max(-v, u_prev[k] - a * dt), min(v, u_prev[k] + a * dt)
        above = joint.upper.value - c.rounding_margin - q[k]
        below = q[k] - joint.lower.value - c.rounding_margin
        low[k] = np.clip(-max_approach_speed(s, below, a), floor, ceiling)
        high[k] = np.clip(max_approach_speed(s, above, a), low[k], ceiling)
    return low, high


def max_approach_speed(s, d, a):
    """Largest speed toward a joint limit at distance d from which the joint can stop with a dt per period."""
    dt, alpha = s.robot_model.period, s.config.alpha_joint or s.config.alpha or s.robot_model.alpha
    if d <= 0.0:
        return max(alpha * d, -4.0 * s.config.recovery_speed) - s.config.tracking_error
    half = 0.5 * a * dt
    return min(alpha * d, np.sqrt(half * half + 2.0 * a * d) - half) - s.config.tracking_error


def sphere_jacobians(s, q, middle):
    """Centres (k, 3), their Jacobians (k, 3, n), and their second derivative (k, 3) along `middle`."""
    J = np.stack(
        [
            (sphere_centres(s, q + DIFFERENCE_STEP * e) - sphere_centres(s, q - DIFFERENCE_STEP * e))
            / (2.0 * DIFFERENCE_STEP)
            for e in np.eye(s.robot_model.n)
        ],
        axis=2,
    )
    return sphere_centres(s, q), J, second_derivative(s, q, middle)


def second_derivative(s, q, middle, measure=lambda centres: centres):
    """Second derivative along `middle` of the centres (k, 3), or of a measure of them."""
    step = 1e-4
    ahead, behind = (sphere_centres(s, q + sign * step * middle) for sign in (1.0, -1.0))
    return (measure(ahead) - 2.0 * measure(sphere_centres(s, q)) + measure(behind)) / step**2


def approach_speed(s, alpha, h, deceleration):
    """Largest rate at which h may fall: alpha h, and at h ≥ 0 that after which a stop along the path ends there."""
    advance = 0.5 * max(joint.velocity.value / joint.acceleration.value for joint in s.robot_model.joints)
    return min(alpha * h, max((h - 0.5 * deceleration * advance**2) / advance, 0.0))


def all_rows(s, q, u_prev):
    """(A, b, h, name) of every pair, not normalised; name = (kind, i, j) as in the kernel."""
    low, high = control_bounds(s, q, u_prev)
    here, J, bend = sphere_jacobians(s, q, 0.5 * (low + high))
    link, radius, frame = sphere_owners(s)
    out = []
    for j, obstacle in enumerate(s.obstacles):
        if obstacle.known or not s.known_only:
            out += _obstacle_rows(s, j, obstacle, here, J, bend, link, radius, frame, low, high)
    out += _self_rows(s, q, here, J, link, radius, low, high)
    out += [(np.array(row.a), row.b, row.h, ("user", i, 0)) for i, row in enumerate(s.rows)]
    return low, high, out


def _common_margin(s):
    return s.config.sampling_margin + s.config.rounding_margin + s.extra


def _obstacle_rows(s, j, obstacle, here, J, bend, link, radius, frame, low, high):
    c, v = s.config, np.array(obstacle.velocity)
    points = here - v * s.age
    gap = geometry_oracle.surface_distance(obstacle.shape, obstacle.pose, points)
    n = np.stack(
        [
            (
                geometry_oracle.surface_distance(obstacle.shape, obstacle.pose, points + DIFFERENCE_STEP * e)
                - geometry_oracle.surface_distance(obstacle.shape, obstacle.pose, points - DIFFERENCE_STEP * e)
            )
            / (2.0 * DIFFERENCE_STEP)
            for e in np.eye(3)
        ],
        axis=1,
    )
    alpha = obstacle.alpha or c.alpha or s.robot_model.alpha
    out = []
    for i in np.flatnonzero(frame > 0):
        if not applies_to_link(s, obstacle, link[i]):
            continue
        margin = (
            obstacle.margin
            + obstacle.velocity_error * s.age
            + _common_margin(s)
            + s.held_error * (link[i] == len(s.robot_model.links))
        )
        h, permit = gap[i] - radius[i] - margin, permitted_speed(s, obstacle.name, link[i])
        a = n[i] @ J[i]
        deceleration = max(0.0, -(n[i] @ bend[i]))
        allowed = approach_speed(s, alpha, h, deceleration)
        barrier = (
            -max(permit, allowed) if permit is not None else min(-allowed, c.recovery_speed) + obstacle.velocity_error
        )
        b = barrier + n[i] @ v + 0.5 * s.robot_model.period * deceleration
        if obstacle.separation is not None and permit is None:
            b = max(b, -separation_speed(obstacle, h, n[i] @ v))
        b += c.tracking_error * np.abs(a).sum()
        if permit is not None or h < 0.0:
            b = min(b, np.maximum(a * low, a * high).sum())
        out.append((a, b, h + c.sampling_margin, ("obstacle", int(i), j)))
    return out


def _self_rows(s, q, here, J, link, radius, low, high):
    c = s.config
    alpha = c.alpha_self or c.alpha or s.robot_model.alpha
    index = {part.name: k for k, part in enumerate(s.robot_model.links)}
    pairs = [
        sorted((index[a], index[b]), key=lambda k: s.robot_model.links[k].frame)
        for a, b in s.robot_model.self_pairs.kept
    ]
    hand = {near for near, far in pairs if s.robot_model.links[far].group in ("hand", "fingers")}
    out = []
    for near, far in [*pairs, *((near, len(s.robot_model.links)) for near in hand if len(s.held))]:
        margin = c.self_margin + _common_margin(s) + s.held_error * (far == len(s.robot_model.links))
        frames = [*(part.frame for part in s.robot_model.links), s.robot_model.n]
        between = (np.arange(s.robot_model.n) >= frames[near]) & (np.arange(s.robot_model.n) < frames[far])
        middle = 0.5 * (low + high) * between
        bend = second_derivative(s, q, middle, lambda centres: np.linalg.norm(centres[:, None] - centres[None], axis=2))
        for i in np.flatnonzero(link == near):
            for k in np.flatnonzero(link == far):
                way = here[k] - here[i]
                distance = np.linalg.norm(way)
                n, h = way / distance, distance - radius[i] - radius[k] - margin
                a = n @ (J[k] - J[i])
                deceleration = max(0.0, -bend[k, i])
                b = min(-approach_speed(s, alpha, h, deceleration), c.recovery_speed)
                b += 0.5 * s.robot_model.period * deceleration
                b += c.tracking_error * np.abs(a).sum()
                if h < 0.0:
                    b = min(b, np.maximum(a * low, a * high).sum())
                out.append((a, b, h + c.sampling_margin, ("self", int(k), int(i))))
    return out


def link_names(s, link):
    """Names by which a permit or `Obstacle.parts` may refer to this link."""
    return (
        ("held",)
        if link == len(s.robot_model.links)
        else (s.robot_model.links[link].name, s.robot_model.links[link].group)
    )


def permitted_speed(s, obstacle, link):
    """The contact speed of the last permit for this link and obstacle, or None."""
    speeds = [c.speed for c in s.permits if c.obstacle == obstacle and c.robot_part in link_names(s, link)]
    return speeds[-1] if speeds else None


def applies_to_link(s, obstacle, link):
    """Whether the obstacle applies to this link."""
    return not obstacle.parts or bool(set(obstacle.parts) & set(link_names(s, link)))


def separation_speed(obstacle, d, approach):
    """The v of d = v_h (T_r + v/a) + v T_r + v²/(2a), by bisection; 0 if there is none."""
    apart = obstacle.separation
    person = max(apart.approach, approach + obstacle.velocity_error, 0.0)

    def needed(v):
        return person * (apart.reaction + v / apart.brake) + v * apart.reaction + v * v / (2.0 * apart.brake)

    low, high = 0.0, 1e3
    if needed(0.0) >= d:
        return 0.0
    for _ in range(80):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if needed(middle) < d else (low, middle)
    return low
