"""Every link pair is kept or excluded for a valid reason, and the kept pairs have clearance where the arm works."""

from itertools import combinations

import numpy as np
import pytest

from dualbrain.robots.collision_model.self_collision import (
    MIN_EXCLUDED_CLEARANCE,
    chain_frames,
    choose_pairs,
    link_clearance,
    min_clearances,
    random_configurations,
    unit_quaternion_to_matrix,
)
from tests.robots.panda_oracle import PANDA, link_spheres

COVER = {link.name: link_spheres(link.name) for link in PANDA.links}
LOWER = np.array([joint.lower.value for joint in PANDA.joints])
UPPER = np.array([joint.upper.value for joint in PANDA.joints])
HAND = unit_quaternion_to_matrix(PANDA.links[8].quaternion)
TOOL = np.array(PANDA.links[8].translation) + HAND @ np.array(PANDA.tool.translation)


def clearances(q):
    return min_clearances(PANDA.joints, PANDA.links, COVER, q, (0.0, 0.02, 0.04))


def downward_poses(count, rng):
    """Configurations with the tool pointing down over the table, by damped least squares from home."""
    position = rng.uniform((0.35, -0.45, 0.02), (0.7, 0.45, 0.5), (count, 3))
    yaw = rng.uniform(-np.pi / 2, np.pi / 2, count)
    c, s, zero = np.cos(yaw), np.sin(yaw), np.zeros(count)
    target = np.stack([c, s, zero, s, -c, zero, zero, zero, zero - 1], axis=1).reshape(-1, 3, 3)
    home = np.array(PANDA.home)
    q = np.tile(home, (count, 1))
    q[:, 0] = np.arctan2(position[:, 1], position[:, 0])
    for _ in range(80):
        turns, origins = chain_frames(PANDA.joints, q)
        tool, turn = origins[:, 7] + turns[:, 7] @ TOOL, turns[:, 7] @ HAND
        error = np.hstack([position - tool, 0.5 * np.cross(turn, target, axis=1).sum(axis=2)])
        axes = turns[:, 1:, :, 2]
        J = np.concatenate([np.cross(axes, tool[:, None] - origins[:, 1:]), axes], axis=2).transpose(0, 2, 1)
        J_plus = J.transpose(0, 2, 1) @ np.linalg.inv(J @ J.transpose(0, 2, 1) + 1e-4 * np.eye(6))
        null_space_step = (np.eye(7) - J_plus @ J) @ (0.05 * (home - q))[:, :, None]
        step = (J_plus @ error[:, :, None] + null_space_step)[:, :, 0]
        q = np.clip(q + np.clip(step, -0.2, 0.2), LOWER + 0.01, UPPER - 0.01)
    return q[np.linalg.norm(error, axis=1) < 2e-3]


def test_every_pair_is_either_kept_or_excluded_with_a_reason():
    listed = [*PANDA.self_pairs.kept, *(pair[:2] for pair in PANDA.self_pairs.allowed)]
    assert sorted(listed) == sorted(combinations([link.name for link in PANDA.links], 2))
    assert all(reason for *_, reason in PANDA.self_pairs.allowed)


def test_adjacent_links_are_on_the_same_or_consecutive_frames():
    frame = {link.name: link.frame for link in PANDA.links}
    for a, b, reason in PANDA.self_pairs.allowed:
        if reason == "adjacent":
            assert abs(frame[a] - frame[b]) <= 1


def test_excluded_pairs_have_clearance_in_new_configurations():
    gaps = clearances(random_configurations(PANDA.joints, 3000, np.random.default_rng(11)))
    for a, b, reason in PANDA.self_pairs.allowed:
        if reason.startswith("never"):
            assert gaps[a, b] > MIN_EXCLUDED_CLEARANCE - 0.005


def test_kept_pairs_have_clearance_at_home():
    gaps = clearances(np.array([PANDA.home]))
    assert min(gaps[pair] for pair in PANDA.self_pairs.kept) > 0.010


def test_kept_pairs_have_clearance_while_the_hand_points_down_over_the_table():
    q = downward_poses(400, np.random.default_rng(12))
    assert len(q) > 350
    gaps = clearances(q)
    assert min(gaps[pair] for pair in PANDA.self_pairs.kept) > 0.005


@pytest.mark.slow
def test_kept_pairs_never_overlap_and_rarely_come_near_over_many_downward_poses():
    """Not 5 mm everywhere: about one pose in 10 000 (joint 6 near 1.3, joint 7 near 2.5) has link5-link7 at 1.4 mm."""
    poses = downward_poses(5000, np.random.default_rng(13))
    gaps = np.array([min(clearances(q[None])[pair] for pair in PANDA.self_pairs.kept) for q in poses[:500]])
    assert np.mean(gaps < 0.005) <= 0.002
    least = clearances(poses)
    assert min(least[pair] for pair in PANDA.self_pairs.kept) > 0.001


def test_a_folded_arm_collides_with_itself():
    gaps = clearances(random_configurations(PANDA.joints, 2000, np.random.default_rng(14)))
    assert gaps["link2", "hand"] < 0


def test_clearance_is_the_smallest_gap_between_surfaces():
    rng = np.random.default_rng(15)
    a, b, r, s = rng.random((1, 4, 3)), rng.random((1, 5, 3)) + 2, rng.random(4), rng.random(5)
    gaps = [np.linalg.norm(a[0, i] - b[0, j]) - r[i] - s[j] for i in range(4) for j in range(5)]
    assert link_clearance(a, b, r, s)[0] == pytest.approx(min(gaps))


def test_pairs_allowed_by_design_are_excluded_with_their_reason():
    chosen = choose_pairs(
        PANDA.joints,
        PANDA.links,
        COVER,
        allowed_by_design={("link0", "hand"): "why"},
        n_samples=50,
        rng=np.random.default_rng(0),
        opening=0.04,
    )
    assert ("link0", "hand", "why") in chosen.allowed
    assert ("link0", "hand") not in chosen.kept
