"""The FR3's limits beside the maker's own, which libfranka computes as functions of the joint's position."""

import numpy as np
import pytest

from dualbrain.robots.builtin import fr3
from dualbrain.robots.loader import load_robot

# libfranka, include/franka/rate_limiting.h: fastest v, then |v| ≤ sqrt(k (end − q)) − c towards the end of the range
FASTEST = (2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26)
C = (0.30, 0.20, 0.20, 0.30, 0.35, 0.35, 0.35)
K = (12.0, 5.17, 7.00, 8.00, 34.0, 11.0, 34.0)
UPPER = (2.75010, 1.79180, 2.90650, -0.1458, 2.81010, 4.52050, 3.01960)
LOWER = (-2.750100, -1.791800, -2.906500, -3.048100, -2.810100, 0.54092, -3.019600)


def allowed(joint, room):
    """The maker's velocity limit at `room` [rad] before the end of the range."""
    return min(FASTEST[joint], max(0.0, np.sqrt(max(0.0, K[joint] * room)) - C[joint]))


@pytest.mark.parametrize("k", range(7))
def test_everywhere_in_our_range_our_velocity_is_one_that_the_maker_allows(k):
    joint = load_robot("fr3").joints[k]
    low, high, v = joint.lower.value, joint.upper.value, joint.velocity.value
    for q in np.linspace(low, high, 200):
        assert v <= allowed(k, UPPER[k] - q) + 0.01
        assert v <= allowed(k, q - LOWER[k]) + 0.01
    assert min(allowed(k, UPPER[k] - high), allowed(k, low - LOWER[k])) < v + 0.35, "the range could be far wider"


def test_acceleration_and_jerk_are_the_makers_and_say_so():
    robot_model = load_robot("fr3")
    assert robot_model.joints == fr3.joints()
    for joint in robot_model.joints:
        assert (joint.acceleration.value, joint.jerk.value) == (10.0, 5000.0)
        assert "kMaxJointAcceleration" in joint.acceleration.provenance
        assert "kMaxJointJerk" in joint.jerk.provenance
