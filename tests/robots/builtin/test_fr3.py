"""The limits of the FR3 are within those of the manufacturer, which libfranka computes from the joint position."""

import numpy as np
import pytest

from dualbrain.robots.builtin import fr3
from dualbrain.robots.loader import load_robot

# libfranka, include/franka/rate_limiting.h: |v| ≤ v_max and |v| ≤ sqrt(k (end − q)) − c towards the end of the range
V_MAX = (2.62, 2.62, 2.62, 2.62, 5.26, 4.18, 5.26)
C = (0.30, 0.20, 0.20, 0.30, 0.35, 0.35, 0.35)
K = (12.0, 5.17, 7.00, 8.00, 34.0, 11.0, 34.0)
UPPER = (2.75010, 1.79180, 2.90650, -0.1458, 2.81010, 4.52050, 3.01960)
LOWER = (-2.750100, -1.791800, -2.906500, -3.048100, -2.810100, 0.54092, -3.019600)


def manufacturer_limit(joint, distance):
    """The manufacturer's velocity limit [rad/s] at `distance` [rad] from the end of the range."""
    return min(V_MAX[joint], max(0.0, np.sqrt(max(0.0, K[joint] * distance)) - C[joint]))


@pytest.mark.parametrize("k", range(7))
def test_the_velocity_limit_is_allowed_by_the_manufacturer_in_the_whole_range(k):
    joint = load_robot("fr3").joints[k]
    low, high, v = joint.lower.value, joint.upper.value, joint.velocity.value
    for q in np.linspace(low, high, 200):
        assert v <= manufacturer_limit(k, UPPER[k] - q) + 0.01
        assert v <= manufacturer_limit(k, q - LOWER[k]) + 0.01
    at_the_ends = min(manufacturer_limit(k, UPPER[k] - high), manufacturer_limit(k, low - LOWER[k]))
    assert at_the_ends < v + 0.35, "the range could be much wider"


def test_acceleration_and_jerk_are_those_of_the_manufacturer():
    robot_model = load_robot("fr3")
    assert robot_model.joints == fr3.joints()
    for joint in robot_model.joints:
        assert (joint.acceleration.value, joint.jerk.value) == (10.0, 5000.0)
        assert "kMaxJointAcceleration" in joint.acceleration.provenance
        assert "kMaxJointJerk" in joint.jerk.provenance
