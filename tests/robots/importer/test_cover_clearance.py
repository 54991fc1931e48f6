"""Links whose loose spheres leave each other no room are found, and covered more tightly until there is room."""

import numpy as np
import pytest

from dualbrain.robots.collision_model.coverage import SphereSet
from dualbrain.robots.collision_model.self_collision_sampling import SampledPairs, sample_pairs
from dualbrain.robots.importer import build_arm
from dualbrain.robots.importer.urdf import read_urdf
from dualbrain.robots.model import SelfCollisionPairs
from tests.robots.importer.test_cbf_gain import LENGTH, planar_arm
from tests.robots.importer.urdf_builder import full_featured_arm, limit_policy, write_file


@pytest.mark.parametrize(("radius", "congested"), [(0.22, {"part1", "part3"}), (0.1, set())])
def test_the_links_of_a_congested_pair_are_named(radius, congested):
    """Two spheres whose centres are 0.15 to 0.45 m apart, depending on the joint between them."""
    joints, links, _ = planar_arm(2.0, 10.0)
    positions = {"part1": 0.5 * LENGTH, "part2": 0.0, "part3": 0.0}
    cover = {name: SphereSet(np.array([[x, 0.0, 0.0]]), np.array([radius])) for name, x in positions.items()}
    angles = np.linspace(-np.pi, np.pi, 720)
    ring = LENGTH * np.column_stack([np.cos(angles), np.sin(angles), np.zeros(720)])
    surfaces = dict.fromkeys(cover, ring)
    sampled = sample_pairs(joints, links, cover, surfaces, n_samples=2000, rng=np.random.default_rng(0))
    assert ("part1", "part3") in sampled.pairs.kept
    assert sampled.congested_links == congested


def test_congested_links_are_fitted_more_tightly_until_there_is_room(tmp_path, monkeypatch):
    weights, congested = [], [frozenset({"upper"}), frozenset({"upper", "lower"}), frozenset()]
    fit_links = build_arm.fit_links

    def record_weights(shapes, weight, *rest):
        weights.append(dict(weight))
        return fit_links(shapes, weight, *rest)

    def sample_pairs(*_, **__):
        return SampledPairs(SelfCollisionPairs((), ()), congested[len(weights) - 1])

    monkeypatch.setattr(build_arm, "fit_links", record_weights)
    monkeypatch.setattr(build_arm, "sample_pairs", sample_pairs)
    build_arm.build_arm(
        read_urdf(write_file(tmp_path, full_featured_arm())),
        limit_policy(),
        build_arm.ImportOptions(quick=True, sphere_budget=20),
    )
    tighter = [{name: now[name] / weights[0][name] for name in now if now[name] != weights[0][name]} for now in weights]
    once, twice = (pytest.approx(build_arm.TIGHTENING_FACTOR**k) for k in (1, 2))
    assert tighter == [{}, {"upper": once}, {"upper": twice, "lower": once}]
