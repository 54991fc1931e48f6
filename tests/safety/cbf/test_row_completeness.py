"""Completeness of rows: no pair is missing that a control in the box could violate, or that is nearest.

The kernel skips links, obstacles and groups of both by lower bounds. Here all pairs of random cases are evaluated in
float64 without bounds and compared with the rows of the kernel: none is missing, and each is right.
"""

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose, Sphere
from dualbrain.robots.interface import RobotState
from dualbrain.safety.cbf.filter import Contact, Obstacle, SafetyFilter
from dualbrain.safety.cbf.result import Reason
from tests.safety import geometry_oracle, random_scenes
from tests.safety.cbf import exhaustive_rows

SETTINGS = {
    "still": {},
    "no acceleration limits": {"acceleration_limits": False},
    "moving": {"moving": True},
    "parts, gains and permits": {"parts": True},
    "holding": {"holding": True},
    "mobile base": {"mobile": True, "moving": True},
    "everything": {"moving": True, "parts": True, "holding": True},
    "crowd": {"count": 48, "moving": True},
    "balls": {"count": 20, "balls": True, "acceleration_limits": False},
}


@pytest.fixture(scope="module")
def thin(panda):
    """Two spheres per link: fewer than obstacles, so that the kernel loops over spheres."""
    chosen = [s for link in panda.links for s in [s for s in panda.spheres if s.link == link.name][:2]]
    return msgspec.structs.replace(panda, spheres=tuple(chosen))


def solid(rng, balls):
    kind = 0 if balls else rng.choice(4, p=[0.35, 0.3, 0.3, 0.05])
    if kind == 0:
        return Sphere(float(rng.uniform(0.01, 0.15)))
    if kind == 1:
        return Capsule(float(rng.uniform(0.01, 0.08)), float(rng.uniform(0.0, 0.4)))
    return Box(tuple(rng.uniform(0.005, 0.4, 3).tolist())) if kind == 2 else HalfSpace()


def obstacle(rng, index, near, *, moving, parts, balls):
    """An obstacle whose surface is between one centimetre inside and far away from the point `near`."""
    shape, quaternion = solid(rng, balls), random_scenes.random_quaternion(rng)
    way = rng.normal(size=3)
    point = near + way / np.linalg.norm(way) * rng.choice([0.05, 0.2, 0.6, 1.5]) * rng.uniform(0.3, 1.0)
    pose = Pose(tuple(point.tolist()), quaternion)
    depth = float(geometry_oracle.surface_distance(shape, pose, near[None])[0])
    if depth < 0.06:  # move it away, so that few obstacles are inside the robot
        away = (point - near) / np.linalg.norm(point - near)
        up = geometry_oracle.rotation_matrix(quaternion)[:, 2]
        shift = -up * (0.08 - depth) if isinstance(shape, HalfSpace) else away * (0.08 - depth)
        pose = Pose(tuple((point + shift * rng.uniform(0.6, 1.2)).tolist()), quaternion)
    moves = moving and rng.random() < 0.5
    chosen = rng.random() < 0.3 and parts
    return Obstacle(
        f"o{index}",
        shape,
        pose,
        velocity=tuple(rng.uniform(-0.5, 0.5, 3).tolist()) if moves else (0.0, 0.0, 0.0),
        margin=float(rng.choice([0.0, 0.02])),
        velocity_error=0.05 if moves and rng.random() < 0.5 else 0.0,
        static=not moves,
        alpha=float(rng.choice([1.0, 8.0])) if chosen else None,
        parts=((), ("hand",), ("fingers", "link4"), ("held", "link6"))[int(rng.integers(4))] if chosen else (),
    )


def moment(body, rng, *, count=9, moving=False, parts=False, holding=False, mobile=False, balls=False, **_):
    """A random case; its box is set after the kernel has computed it."""
    low = np.array([joint.lower.value for joint in body.joints]) + 0.05
    high = np.array([joint.upper.value for joint in body.joints]) - 0.05
    q, opening = rng.uniform(low, high), float(rng.uniform(0.0, 0.04))
    base = (np.eye(3), np.zeros(3))
    if mobile:
        base = (geometry_oracle.rotation_matrix(random_scenes.random_quaternion(rng)), rng.uniform(-5.0, 5.0, 3))
    centres = base[1] + geometry_oracle.sphere_centres(body, q[None], opening)[0][0] @ base[0].T
    kinds = {"moving": moving, "parts": parts, "balls": balls}
    obstacles = [obstacle(rng, k, centres[rng.integers(len(centres))], **kinds) for k in range(count)]
    permits = {("hand", 0): 0.05, ("left_finger", 1): 0.02, ("right_finger", 1): 0.02} if parts else {}
    held = np.empty((0, 4))
    if holding:
        k = int(rng.integers(1, 9))
        held = np.concatenate([rng.uniform(-0.08, 0.08, (k, 3)), rng.uniform(0.005, 0.03, (k, 1))], axis=1)
    return exhaustive_rows.PairCase(
        q, low, high, obstacles, 0.1 if moving else 0.0, opening, permits, held, 0.004 * holding, base
    )


def run_step(safety, setting, rng, *, mobile):
    """One step of `safety` in the case, at a random speed; sets the box of the case."""
    body = safety.robot_model
    safety.observe(setting.obstacles, 0.0)
    permits = {(("fingers" if "finger" in link else link), j): speed for (link, j), speed in setting.permits.items()}
    safety.permit([Contact(part, f"o{j}", speed) for (part, j), speed in permits.items()])
    if len(setting.held) > 0:
        safety.attach(setting.held, setting.held_error)
    if mobile:
        safety._kernel.set_base_pose(np.concatenate([setting.base[0].ravel(), setting.base[1]]))
    fastest = np.array([joint.velocity.value for joint in body.joints])
    u_prev = fastest * rng.uniform(-1.0, 1.0, body.n) * rng.choice([0.0, 0.2, 1.0])
    safety.reset(u_prev)
    state = RobotState(
        stamp=setting.age,
        sequence=0,
        q=setting.q,
        v=np.zeros(body.n),
        opening=setting.opening,
        finger_forces=(0.0, 0.0),
    )
    answer = safety.filter(state, u_prev, setting.age)
    setting.low, setting.high = (np.array(side) for side in safety._kernel.box())
    return answer


def compare(safety, setting, answer, tolerance):
    """Assert that no row is missing or wrong and that h_min is right; returns the number of pairs that could bind."""
    every, sampling = (
        exhaustive_rows.all_pair_rows(safety.robot_model, safety.config, setting),
        safety.config.sampling_margin,
    )
    rows = safety._kernel.rows()
    worst = np.where(every.a > 0, every.a * setting.low, every.a * setting.high).sum(axis=1)
    best = np.where(every.a > 0, every.a * setting.high, every.a * setting.low).sum(axis=1)
    near = (every.h < exhaustive_rows.ALWAYS_ROW_DISTANCE - tolerance) & ~every.permitted
    needed = ((worst < every.b - tolerance) | near) & (np.linalg.norm(every.a, axis=1) > 1.1e-4)
    index = {name: k for k, name in enumerate(every.names())}
    at = np.array([index[row[:3]] for row in rows], int)  # fails for a pair that need not keep apart
    assert len(set(at.tolist())) == len(at) >= answer.n_rows
    missing = np.setdiff1d(np.flatnonzero(needed), at)
    assert len(missing) == 0, [every.names()[k] for k in missing]
    if len(rows) > 0:
        h, norm, b = (np.array([row[e] for row in rows]) for e in (3, 4, 5))
        a = np.array([row[6] for row in rows]) * norm[:, None]
        np.testing.assert_allclose(h, every.h[at] + sampling, atol=tolerance)
        clear = every.h[at] > tolerance  # inside, normals jump and the box limits the right-hand side
        np.testing.assert_allclose(a[clear], every.a[at][clear], atol=20 * tolerance)
        if not answer.reason & Reason.INFEASIBLE:  # otherwise right-hand sides are those of the relaxation
            expected = np.where(every.permitted, np.minimum(every.b, best), every.b)[at]
            np.testing.assert_allclose((b * norm)[clear], expected[clear], atol=50 * tolerance)
    assert answer.h_min == pytest.approx(every.h[~every.permitted].min() + sampling, abs=tolerance)
    return int(needed.sum())


def check(body, changes, real, times, seed):
    rng, tolerance, needed = np.random.default_rng(seed), 1e-7 if real == "float64" else 1e-5, 0
    limits = changes.get("acceleration_limits", True)
    tracking = 0.002 if seed % 2 else tuple(np.random.default_rng(seed).uniform(0.0, 0.01, body.n).tolist())
    config = random_scenes.exact_config(
        precision=real, alpha=body.alpha, tracking_error=tracking, acceleration_limits=limits
    )
    safety = SafetyFilter(body, config)
    for _ in range(times):
        setting = moment(body, rng, **changes)
        answer = run_step(safety, setting, rng, mobile="mobile" in changes)
        if not answer.reason & Reason.ROW_OVERFLOW:  # otherwise the step brakes
            needed += compare(safety, setting, answer, tolerance)
    assert needed > times / 4


@pytest.mark.parametrize("times", [12, pytest.param(30, marks=pytest.mark.slow)])
@pytest.mark.parametrize("setting", SETTINGS, ids=str)
def test_no_row_is_missing_and_h_min_is_the_nearest(thin, setting, times):
    check(thin, SETTINGS[setting], "float32", times, 11)


@pytest.mark.parametrize("times", [20, pytest.param(60, marks=pytest.mark.slow)])
def test_no_row_is_missing_with_one_tracking_error_for_each_joint(thin, times):
    check(thin, {}, "float32", times, 12)
    check(thin, {}, "float64", times, 14)


def test_far_from_everything_h_min_is_still_the_nearest(thin, rng):
    """At rest no row binds, so that only the search for the nearest pair keeps links from being skipped."""
    alone = msgspec.structs.replace(thin, self_pairs=msgspec.structs.replace(thin.self_pairs, kept=()))
    safety = SafetyFilter(alone, random_scenes.exact_config(alpha=alone.alpha, tracking_error=0.002))
    for _ in range(150):
        setting = moment(alone, rng, count=12, balls=True)
        q, opening = setting.q[None], setting.opening
        obstacles = [msgspec.structs.replace(obstacle, margin=0.0) for obstacle in setting.obstacles]
        far = [
            obstacle for obstacle in obstacles if geometry_oracle.h_obstacles(alone, q, [obstacle], opening)[0] > 0.1
        ]
        safety.observe(far, 0.0)
        safety.reset()
        got = safety(setting.q, np.zeros(7), np.zeros(7), opening=opening)
        assert got.n_rows == 0
        if far:
            least = geometry_oracle.h_obstacles(alone, q, far, opening)[0]
            assert got.h_min == pytest.approx(least - safety.config.rounding_margin, abs=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize("real", ["float32", "float64"])
@pytest.mark.parametrize("setting", SETTINGS, ids=str)
def test_thousands_of_moments(thin, panda, setting, real):
    limited = SETTINGS[setting].get("acceleration_limits", True)  # the full model has more rows than the capacity
    for seed, body in enumerate((thin, panda) if limited else (thin,)):
        check(body, SETTINGS[setting], real, 100, 100 + seed)
