"""Random robot models and step cases in the kernel's format: joints, links, shapes, permits, held spheres, bases.

The range is larger than that of real robots: link 0 may move, links may have no spheres, joints may be prismatic, and
eight joints fill the capacity of the kernel.
"""

from dataclasses import dataclass, field

import numpy as np
from scipy.spatial.transform import Rotation

from dualbrain.safety.cbf.compiled import _kernel64
from dualbrain.safety.cbf.result import FilterResult, FilterStatus, RowNames

CAPSULE, BOX, HALF_SPACE = range(3)
KNOWN_FLAG, STATIC_FLAG = 1, 2
ALL_LINKS_MASK = float(2**32 - 1)


@dataclass
class StepCase:
    """All inputs of one step; `obstacles` (k, 29) is the obstacle table, `held` (k, 4) is in the last frame."""

    q: np.ndarray
    v: np.ndarray
    u_nom: np.ndarray
    u_prev: np.ndarray
    obstacles: np.ndarray
    opening: float = 0.0
    age: float = 0.0
    permits: dict = field(default_factory=dict)  # (link, obstacle) -> speed [m/s]
    held: np.ndarray = field(default_factory=lambda: np.empty((0, 4)))
    held_error: float = 0.0
    rows: np.ndarray = field(default_factory=lambda: np.empty((0, 0)))
    base: tuple | None = None


def random_rotation(rng):
    return Rotation.random(random_state=rng).as_matrix()


def random_model(rng, n=7, links=6, *, slides=True, alpha=None):
    """A model of `n` joints, some of them prismatic; a link may have no spheres."""
    frames = np.sort(rng.integers(0, n + 1, links))
    counts = rng.integers(0, 10 if links < 12 else 4, links)
    counts[-1] = max(counts[-1], 2)
    total = int(counts.sum())
    spheres = np.column_stack(
        [
            rng.uniform(-0.12, 0.12, (total, 3)),
            rng.uniform(0.01, 0.06, total),
            rng.choice([0.0, 1.0], (total, 1)) * rng.uniform(-1.0, 1.0, (total, 3)),
        ]
    )
    kind = (rng.random(n) < 0.2) * float(slides)
    pairs = [(a, b) for a in range(links) for b in range(links) if frames[a] < frames[b] - 1 and rng.random() < 0.7][
        :96
    ]
    v_max = rng.uniform(0.5, 2.5, n)
    a_max = (
        v_max * rng.uniform(2.0, 10.0, n) * rng.choice([1.0, 5.0, 50.0])
    )  # the last factor gives a box as wide as v_max
    return {
        "n": n,
        "period": float(rng.choice([1e-3, 4e-3])),
        "alpha": alpha or float(rng.uniform(1.0, 6.0)),
        "alpha_self": float(rng.uniform(1.0, 6.0)),
        "alpha_joint": float(rng.uniform(1.0, 6.0)),
        "recovery": float(rng.uniform(0.01, 0.1)),
        "sampling": float(rng.uniform(0.0, 5e-4)),
        "rounding": float(rng.uniform(0.0, 1e-4)),
        "self_margin": float(rng.uniform(0.0, 5e-3)),
        "lag": float(rng.uniform(0.0, 0.02)),
        "speed_limit": 0.0,
        "moving_base": float(n > 1 and kind[0] > 0.0 and not kind[1] > 0.0 and 1 not in frames),
        "speed_first_joint": 0.0,
        "state_age_max": 0.02,
        "scene_age_max": 0.3,
        "joint_kind": kind,
        "joint_rotation": np.concatenate([random_rotation(rng).ravel() for _ in range(n)]),
        "joint_offset": rng.uniform(-0.25, 0.25, 3 * n),
        "q_lower": -rng.uniform(1.5, 2.5, n),
        "q_upper": rng.uniform(1.5, 2.5, n),
        "v_max": v_max,
        "a_max": a_max,
        "j_max": np.zeros(n),
        "tracking": random_tracking(rng, n),
        "scale": random_scale(rng, n),
        "tool_rotation": random_rotation(rng).ravel(),
        "tool_offset": rng.uniform(-0.1, 0.1, 3),
        "link_frame": frames.astype(float),
        "link_first": np.concatenate([[0.0], np.cumsum(counts)]),
        "spheres": spheres,
        "pairs": np.array(pairs, float).reshape(-1),
        "held_links": np.flatnonzero((frames < n) & (rng.random(links) < 0.5)).astype(float),
    }


def random_tracking(rng, n):
    """Tracking margins [rad/s]: none, the same for all joints, or one for each, of which some may be zero."""
    largest = float(rng.uniform(0.0, 5e-3))
    match rng.integers(3):
        case 0:
            return np.full(n, largest)
        case 1:
            return rng.uniform(0.0, 1.0, n) * largest * (rng.random(n) < 0.8)
        case _:
            return np.zeros(n)


def random_scale(rng, n):
    """The scale S of a random weight: u = u_nom + S x."""
    M = np.eye(n) + 0.2 * rng.normal(size=(n, n))
    return np.ascontiguousarray(np.linalg.inv(np.linalg.cholesky(M @ M.T)).T)


def random_obstacle(rng, near, links, *, moving, with_separation, spheres_only=False):
    """One row of the obstacle table, of any shape or a sphere, from around the point `near` to metres away."""
    shape = CAPSULE if spheres_only else int(rng.choice(3, p=[0.6, 0.3, 0.1]))
    half = {
        CAPSULE: (0.0, 0.0, 0.0 if spheres_only else rng.choice([0.0, 0.2])),
        BOX: rng.uniform(0.01, 0.3, 3),
        HALF_SPACE: (0.0, 0.0, 0.0),
    }
    radius = rng.uniform(0.01, 0.1) if shape == CAPSULE else 0.0
    direction = rng.normal(size=3)
    place = near + direction / np.linalg.norm(direction) * rng.choice([0.05, 0.15, 0.3, 1.0, 2.0])
    moves = moving and rng.random() < 0.5
    velocity = rng.uniform(-0.5, 0.5, 3) if moves else np.zeros(3)
    separation = (0.1, 1.0, rng.choice([0.0, 0.3])) if with_separation and rng.random() < 0.3 else (0.0, 0.0, 0.0)
    mask = ALL_LINKS_MASK if rng.random() < 0.7 else float(rng.integers(0, 2 ** (links + 1)))
    flags = float(KNOWN_FLAG * (rng.random() < 0.5) + STATIC_FLAG * (not moves))
    return np.array(
        [
            shape,
            flags,
            rng.integers(1, 5),
            mask,
            rng.choice([0.0, 0.9, 5.0]),
            *place,
            *random_rotation(rng).ravel(),
            *half[shape],
            radius,
            *velocity,
            rng.choice([0.0, 0.02]),
            0.03 * moves,
            *separation,
        ]
    )


def random_case(
    rng,
    model,
    points,
    *,
    n_obstacles=8,
    moving=True,
    with_separation=True,
    permits=True,
    n_held=4,
    n_rows=2,
    mobile=False,
    spheres_only=False,
):
    """A random case of `model`; obstacles are near the `points` (k, 3), with `spheres_only` all spheres."""
    n, links = model["n"], len(model["link_frame"])
    base = (random_rotation(rng), rng.uniform(-3.0, 3.0, 3)) if mobile else None
    R, p = base or (np.eye(3), np.zeros(3))
    table = [
        random_obstacle(
            rng,
            p + R @ points[rng.integers(len(points))],
            links,
            moving=moving,
            with_separation=with_separation,
            spheres_only=spheres_only,
        )
        for _ in range(n_obstacles)
    ]
    allowed = {
        (int(rng.integers(links + 1)), int(rng.integers(n_obstacles))): float(rng.choice([0.0, 0.05]))
        for _ in range(3 if permits and n_obstacles else 0)
    }
    carried = np.column_stack([rng.uniform(-0.1, 0.1, (n_held, 3)), rng.uniform(0.01, 0.04, n_held)])
    user = [[*rng.normal(size=n), rng.uniform(-3.0, -1.0), 0.01 * k, 1 + k % 4] for k in range(n_rows)]
    u_prev = model["v_max"] * rng.uniform(-1.0, 1.0, n) * rng.choice([0.0, 0.1, 0.8])
    return StepCase(
        rng.uniform(-1.6, 1.6, n),
        rng.uniform(-0.5, 0.5, n),
        u_prev + 0.01 * rng.normal(size=n),
        u_prev,
        np.array(table).reshape(-1, 29),
        float(rng.uniform(0.0, 0.04)),
        0.1 * moving,
        allowed,
        carried,
        0.003 * (n_held > 0),
        np.array(user).reshape(-1, n + 3),
        base,
    )


def make_kernel(model, build=_kernel64):
    """A kernel of `model` with the result type of `SafetyFilter`."""
    made = build.Kernel(model)
    made.set_result_type(FilterResult, tuple(FilterStatus))
    return made


def upload_case(kernel, model, case):
    """Set the obstacles, permits, held spheres, rows, base and last control."""
    kernel.set_obstacles(np.ascontiguousarray(case.obstacles))
    kernel.clear_permits()
    for (link, obstacle), speed in case.permits.items():
        kernel.permit(link, obstacle, speed)
    kernel.attach(np.ascontiguousarray(case.held), case.held_error)
    kernel.constrain(np.ascontiguousarray(case.rows))
    if case.base:
        kernel.set_base_pose(np.concatenate([case.base[0].ravel(), case.base[1]]))
    kernel.reset(case.u_prev, np.zeros_like(case.u_prev))


def run_step(kernel, case):
    """The result of one step."""
    names = RowNames(spheres=(), obstacles=(), joints=(), v_max=())
    return kernel.step(case.q, case.v, case.u_nom, case.opening, 0.0, case.age, names)


def step_internals(made, n, links, extra=0.0, *, known_only=False):
    """Every number of the last step as arrays, without unused joints and spheres; lists per link as lists."""
    raw = {
        part: {name: np.frombuffer(data) for name, data in fields.items()}
        for part, fields in made.debug_readout(extra, known_only).items()
    }
    room = {"joints": _kernel64.max_joints, "links": _kernel64.max_links + 1}
    shapes = {
        ("model", "reach"): room["joints"],
        ("model", "link_reach"): room["joints"],
        ("model", "bounding_sphere"): room["links"] - 1,
        ("model", "scale"): room["joints"],
        ("motion", "chain"): room["joints"] + 1,
        ("rows", "a"): room["joints"],
        ("step", "warm"): room["joints"] + 1,
        ("step", "rotation"): room["joints"] + 1,
        ("step", "origin"): room["joints"] + 1,
        ("scene", "permit"): room["links"],
        ("broadphase", "index"): room["links"],
    }
    for (part, name), rows in shapes.items():
        if part in raw:
            raw[part][name] = raw[part][name].reshape(rows, -1)
    if "broadphase" in raw:
        counts = raw["broadphase"]["count"].astype(int)
        raw["broadphase"]["near"] = [
            raw["broadphase"]["index"][link, : counts[link]].astype(int) for link in range(links + 1)
        ]
    return raw
