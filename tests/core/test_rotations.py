"""Quaternions, matrices and rotation vectors agree with each other and with the exponential map."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.core.geometry.rotations import matrix_to_quaternion, quaternion_to_matrix, rotation_error

directions = st.tuples(*[st.floats(-1.0, 1.0)] * 3).filter(lambda v: np.linalg.norm(v) > 1e-2)
angles = st.floats(1e-4, np.pi - 1e-4)


def turn(axis: tuple[float, float, float], angle: float) -> np.ndarray:
    """Rodrigues' formula, independent of the code under test."""
    k = np.asarray(axis) / np.linalg.norm(axis)
    K = np.array([[0, -k[2], k[1]], [k[2], 0, -k[0]], [-k[1], k[0], 0]])
    return np.eye(3) + np.sin(angle) * K + (1 - np.cos(angle)) * K @ K


@given(directions, angles)
def test_quaternion_and_matrix_are_inverse(axis, angle):
    R = turn(axis, angle)
    assert np.allclose(quaternion_to_matrix(matrix_to_quaternion(R)), R, atol=1e-12)


@given(directions, angles, directions, angles)
def test_rotation_error_turns_current_into_target(axis, angle, other, other_angle):
    current, target = turn(axis, angle), turn(other, other_angle)
    e = rotation_error(current, target)
    size = float(np.linalg.norm(e))
    rebuilt = turn(tuple(e), size) @ current if size > 1e-9 else current
    assert size <= np.pi + 1e-9
    assert np.allclose(rebuilt, target, atol=1e-6)


def test_half_a_turn_is_found():
    for axis in np.eye(3):
        e = rotation_error(np.eye(3), turn(tuple(axis), np.pi))
        assert np.isclose(np.linalg.norm(e), np.pi)
        assert np.isclose(abs(e @ axis), np.pi)
