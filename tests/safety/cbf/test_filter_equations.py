"""The filter against its equations: the result is the closest control under every row that numpy computes.

The reference includes every pair and does not use the kernel; an independent solver (DAQP) finds its closest control.
Wrong rows, culled rows that could bind, and mistakes in units, margins, indices or the box all change the control.
"""

from ctypes import c_int

import daqp
import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere
from dualbrain.safety.cbf.filter import Contact, FilterStatus, Obstacle, SafetyFilter
from dualbrain.safety.cbf.obstacles import SpeedAndSeparation
from dualbrain.safety.cbf.rows import ConstraintRow
from tests.safety import random_scenes
from tests.safety.cbf import filter_equations


def sliding(body):
    """The robot model with two prismatic joints at its base, like a gantry."""
    joints = list(body.joints)
    for k in range(2):
        low, high = (msgspec.structs.replace(b, value=v) for b, v in ((joints[k].lower, -0.4), (joints[k].upper, 0.4)))
        joints[k] = msgspec.structs.replace(joints[k], kind="prismatic", lower=low, upper=high)
    return msgspec.structs.replace(body, joints=tuple(joints))


def random_position_near(point, rng, far=0.2):
    """A position near `point`."""
    way = rng.normal(size=3)
    return tuple((point + way / np.linalg.norm(way) * rng.uniform(0.1, far)).tolist())


def random_obstacles(s, q, rng, *, moving=False):
    """A table, and obstacles of every shape near random spheres of the robot."""
    points = filter_equations.sphere_centres(s, q)[5:]
    sizes = rng.uniform(0.02, 0.06, 12)
    shapes = [Sphere(sizes[0]), Capsule(*sizes[1:3]), Box(tuple(sizes[3:6])), Sphere(sizes[6]), Box(tuple(sizes[7:10]))]
    shapes.append(Capsule(*sizes[10:]))
    velocity = tuple(rng.uniform(-0.1, 0.1, 3)) if moving else (0.0, 0.0, 0.0)
    more = {"velocity": velocity, "velocity_error": 0.01 * moving, "static": not moving}
    out = [Obstacle("table", HalfSpace(), Pose((0.0, 0.0, 0.0)), known=True)]
    for k, shape in enumerate(shapes):
        pose = Pose(random_position_near(points[rng.integers(len(points))], rng), random_scenes.random_quaternion(rng))
        out.append(Obstacle(f"t{k}", shape, pose, margin=0.002 * k, known=k % 2 == 0, **more))
    return out


def make_filter(s):
    """A float64 filter with the inputs of the case."""
    safety = SafetyFilter(s.robot_model, s.config)
    safety.observe(s.obstacles, 0.0)
    safety.permit(s.permits)
    safety.constrain(s.rows)
    if len(s.held):
        safety.attach(s.held, s.held_error)
    return safety


def unit_rows(rows):
    """Normalised rows A (m, n) and b (m,) that controls can influence."""
    A, b = np.array([row[0] for row in rows]), np.array([row[1] for row in rows])
    norm = np.linalg.norm(A, axis=1)
    keep = norm > 1e-4
    return A[keep] / norm[keep, None], b[keep] / norm[keep]


def nearest(s, low, high, A, b, u_nom):
    """The control closest to u_nom under all rows, or None."""
    R = np.diag([1.0 / joint.velocity.value**2 for joint in s.robot_model.joints])
    upper, lower = np.concatenate([high, np.full(len(b), 1e30)]), np.concatenate([low, b])
    x, _, flag, _ = daqp.solve(R, -R @ u_nom, np.ascontiguousarray(A), upper, lower, np.zeros(len(upper), dtype=c_int))
    return x if flag == 1 else None


def compare(s, q, u_prev, u_nom, at):
    """Compare the filter with the reference; returns whether rows of the reference were binding."""
    safety = make_filter(s)
    safety.reset(u_prev)
    low, high, rows = filter_equations.all_rows(s, q, u_prev)
    A, b = unit_rows(rows)
    expected = nearest(s, low, high, A, b, u_nom)
    if s.known_only:
        u = safety.project(at(q, t=s.age, opening=s.opening), u_nom, u_prev, s.age)
    else:
        answer = safety.filter(at(q, t=s.age, opening=s.opening), u_nom, s.age)
        u = answer.u
        measured = [row[2] for row in rows if row[3][0] != "user" and not lifted(s, row)]
        assert answer.h_min == pytest.approx(min(10.0, *measured), abs=2e-6)
        assert answer.n_rows <= len(safety.rows())
        if answer.status not in (FilterStatus.SAFE, FilterStatus.MODIFIED):
            assert expected is None or answer.status is FilterStatus.FAULT
            return False
        assert np.min(A @ u - b) > -2e-5
    if expected is None:
        return False
    np.testing.assert_allclose(u, expected, atol=3e-5)
    return bool(np.any(np.abs(expected - np.clip(u_nom, low, high)) > 1e-4))


def lifted(s, row):
    kind, i, j = row[3]
    link = filter_equations.sphere_owners(s)[0][i]
    return kind == "obstacle" and filter_equations.permitted_speed(s, s.obstacles[j].name, link) is not None


def drive(s, q, rng, at, steps=400, every=50):
    """(q, u_prev, u_nom) along a closed loop: random directions at full speed, or toward the nearest row."""
    safety, n = make_filter(s), s.robot_model.n
    v = np.array([joint.velocity.value for joint in s.robot_model.joints])
    u = np.zeros(n)
    for step in range(steps):
        if step % every == 0:
            near_rows = safety.rows() if rng.random() < 0.7 else ()
            desired = v * rng.choice([-1.0, 1.0], n)
            if near_rows:
                desired = -v * np.sign(min(near_rows, key=lambda row: row.h).a)
        if step % every == every - 1:
            yield q.copy(), u.copy(), desired
        state = at(q, t=s.age, opening=s.opening)
        u = safety.project(state, desired, u, s.age) if s.known_only else safety.filter(state, desired, s.age).u
        q = q + s.robot_model.period * u


def setting(kind, body, q, rng):
    """One case for each kind of row."""
    config = random_scenes.exact_config(precision="float64", tracking_error=0.003, self_margin=0.002)
    s = filter_equations.FilterCase(body, config, [], opening=0.03)
    s.obstacles = random_obstacles(s, q, rng, moving=kind in ("moving", "separation"))
    if kind == "moving":
        s.age = 0.2
    if kind == "permits":
        s.permits = [Contact("hand", "t0", 0.03), Contact("fingers", "t1", 0.0), Contact("link5", "t2", 0.1)]
    if kind == "held":
        places = rng.uniform(-0.03, 0.03, (4, 3)) + np.array([0.0, 0.0, 0.06])
        s.held = np.column_stack([places, rng.uniform(0.01, 0.04, 4)])
        s.held_error = 0.003
    if kind == "user":
        s.rows = [
            ConstraintRow(name=f"r{k}", a=tuple(rng.normal(size=body.n).tolist()), b=float(rng.uniform(-1.5, -0.4)))
            for k in range(3)
        ]
    if kind == "separation":
        s.obstacles = [
            msgspec.structs.replace(o, separation=SpeedAndSeparation(0.1, 1.0, 0.05 * k)) if k % 2 else o
            for k, o in enumerate(s.obstacles)
        ]
    if kind == "parts":
        s.obstacles = [
            msgspec.structs.replace(o, parts=("hand", "link6") if k % 2 else (), alpha=1.7 if k == 3 else None)
            for k, o in enumerate(s.obstacles)
        ]
    if kind == "known":
        s.known_only, s.extra = True, config.projection_margin
    if kind == "gains":
        s.config = msgspec.structs.replace(config, alpha=1.3, alpha_self=2.1, alpha_joint=0.9)
    return s


KINDS = ["still", "moving", "permits", "held", "user", "separation", "parts", "known", "gains", "sliding"]


@pytest.mark.parametrize("kind", KINDS)
def test_the_result_is_the_closest_control_under_all_rows(sparse_panda, state_at, kind):
    body = sliding(sparse_panda) if kind == "sliding" else sparse_panda
    rng, bound = np.random.default_rng(KINDS.index(kind)), 0  # bound: number of cases in which a row was binding
    while bound < 4:
        q = np.array(body.home) + rng.uniform(-0.5, 0.5, body.n)
        if kind == "sliding":
            q[:2] = rng.uniform(-0.3, 0.3, 2)
        s = setting(kind, body, q, rng)
        if make_filter(s).filter(state_at(q, t=s.age, opening=s.opening), np.zeros(body.n), s.age).h_min > 0.003:
            bound += sum(compare(s, *moment, state_at) for moment in drive(s, q, rng, state_at))
