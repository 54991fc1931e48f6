"""With the gain α of an imported arm a fast approach can be stopped along the arc; with a larger α it cannot."""

import msgspec
import numpy as np
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.robots.collision_model.coverage import SphereSet
from dualbrain.robots.importer.cbf_gain import (
    MIN_BRAKED_SPEED_SHARE,
    curvature_limited_gain,
    max_axis_distances,
    path_curvature,
)
from dualbrain.robots.loader import encode_robot, load_robot, read_robot
from dualbrain.robots.model import Bound, Joint, Link

LENGTH = 0.3


def make_joint(v, a, x=LENGTH, kind="revolute"):
    return Joint(
        name="j",
        translation=(x, 0.0, 0.0),
        quaternion=(1, 0, 0, 0),
        lower=Bound(-3.0, "rad", "test"),
        upper=Bound(3.0, "rad", "test"),
        velocity=Bound(v, "", ""),
        acceleration=Bound(a, "", ""),
        kind=kind,
    )


def planar_arm(v, a, n=3, kind="revolute"):
    """An arm of n equal links in a plane, with one small sphere at the end of each."""
    joints = tuple(make_joint(v, a, 0.0 if i == 0 else LENGTH, kind) for i in range(n))
    links = tuple(Link(name=f"part{i}", frame=i, group="arm") for i in range(1, n + 1))
    return joints, links, {link.name: SphereSet(np.array([[LENGTH, 0.0, 0.0]]), np.array([0.01])) for link in links}


def tip(q):
    """Position of the end of the arm, independent of the chain kinematics under test."""
    angles = np.cumsum(q, axis=-1)
    return LENGTH * np.stack([np.cos(angles).sum(-1), np.sin(angles).sum(-1)], axis=-1)


def h_derivatives(q, u, normal, step=1e-4):
    """ḣ and u'∇²h u of h = n'p, by finite differences."""
    before, here, after = (normal @ tip(q + k * step * u) for k in (-1, 0, 1))
    return (after - before) / (2 * step), (after - 2 * here + before) / step**2


def approaches(v, a, alpha, rng, count=4000):
    """Fast approaches with ḣ = −α h: pairs of |ḣ| / V and the least h while all joints brake."""
    joints, links, cover = planar_arm(v, a)
    distances = max_axis_distances(joints, links, cover, rng)[links[-1]]
    V, T = float(np.sum(distances * v)), v / a
    found = []
    for _ in range(count):
        q = np.concatenate([[0.0], rng.uniform(-1.2, 1.2, 2)])
        u = v * np.array([1.0, *rng.uniform(-0.2, 1.0, 2)])
        angle = rng.uniform(-np.pi, np.pi)
        normal = np.array([np.cos(angle), np.sin(angle)])
        h_dot, _ = h_derivatives(q, u, normal)
        if h_dot < -MIN_BRAKED_SPEED_SHARE * V:
            h = -h_dot / alpha
            path = q + np.outer(np.linspace(0.0, 0.5 * T, 60), u)
            found.append((-h_dot / V, h + float(np.min(tip(path) @ normal)) - float(tip(q) @ normal)))
    assert len(found) > 50
    return np.array(found)


def test_braking_avoids_contact_at_this_gain_and_not_at_twice_the_straight_line_gain():
    v, a = 4.0, 10.0
    joints, links, cover = planar_arm(v, a)
    gain = curvature_limited_gain(joints, links, cover, np.random.default_rng(0))
    assert gain.value < a / v
    assert gain.unit == "1/s"
    assert "part3" in gain.provenance
    assert approaches(v, a, gain.value, np.random.default_rng(1))[:, 1].min() >= 0.0
    assert approaches(v, a, 2.0 * a / v, np.random.default_rng(1))[:, 1].min() < 0.0


def test_speed_and_curvature_are_bounds():
    rng = np.random.default_rng(3)
    joints, links, cover = planar_arm(2.0, 10.0)
    distances = np.array([3.0, 2.0, 1.0]) * LENGTH  # the stretched arm
    V = 2.0 * distances.sum()
    for _ in range(300):
        angle = rng.uniform(-np.pi, np.pi)
        u = rng.choice([-2.0, 2.0], 3)
        h_dot, curvature = h_derivatives(rng.uniform(-3, 3, 3), u, np.array([np.cos(angle), np.sin(angle)]))
        assert abs(h_dot) <= V + 1e-6
        assert abs(curvature) <= path_curvature(joints, distances) * V + 1e-4
    sampled = max_axis_distances(joints, links, cover, rng)[links[-1]]
    assert np.all(sampled <= distances + 1e-9)
    assert np.all(sampled > 0.9 * distances)


def test_the_gain_of_prismatic_and_slow_joints_is_not_reduced():
    rng = np.random.default_rng(0)
    assert curvature_limited_gain(*planar_arm(4.0, 10.0, kind="prismatic"), rng) is None
    assert curvature_limited_gain(*planar_arm(1.0, 10.0), rng) is None
    fast, slow = (curvature_limited_gain(*planar_arm(v, 10.0), rng).value for v in (5.0, 4.0))
    assert fast / (10.0 / 5.0) < slow / (10.0 / 4.0)


def test_the_path_curvature_of_revolute_and_prismatic_joints():
    revolute, prismatic = make_joint(2.0, 10.0), make_joint(0.5, 1.0, kind="prismatic")
    assert path_curvature((revolute,), np.array([0.7])) == pytest.approx(2.0)
    assert path_curvature((revolute, prismatic), np.array([0.7, 9.0])) == pytest.approx(
        (0.7 * 4 + 2 * 2 * 0.5) / (0.7 * 2 + 0.5)
    )
    assert path_curvature((prismatic, revolute), np.array([9.0, 0.7])) == pytest.approx(0.7 * 4 / (0.5 + 0.7 * 2))


def test_alpha_is_limited_by_the_gain_and_a_gain_of_zero_is_refused(tmp_path):
    panda = load_robot("panda")
    slower = msgspec.structs.replace(panda, gain=Bound(2.0, "1/s", "test"))
    assert panda.gain is None
    assert slower.alpha == 2.0
    assert msgspec.structs.replace(panda, gain=Bound(9.0, "1/s", "test")).alpha == panda.alpha
    file = tmp_path / "body.json"
    file.write_bytes(encode_robot(msgspec.structs.replace(panda, gain=Bound(0.0, "1/s", "test"))))
    with pytest.raises(ConfigurationError, match="gain"):
        read_robot(file)
