"""Robot models and states of the safety tests: the full Panda, and one with few spheres for long loops."""

import msgspec
import numpy as np
import pytest

from dualbrain.robots.interface import RobotState
from dualbrain.robots.loader import load_robot


@pytest.fixture(scope="session")
def panda():
    return load_robot("panda")


@pytest.fixture(scope="session")
def sparse_panda(panda):
    """Every fourth sphere: same kinematics, a quarter of the work."""
    return msgspec.structs.replace(panda, spheres=panda.spheres[::4])


@pytest.fixture
def rng():
    return np.random.default_rng(7)


@pytest.fixture
def state_at():
    """A state at rest (or moving at v) at joint angles q, stamped t."""

    def make(q, v=None, t=0.0, opening=0.04):
        q = np.array(q, float)
        return RobotState(
            stamp=t,
            sequence=0,
            q=q,
            v=np.zeros(len(q)) if v is None else np.array(v, float),
            opening=opening,
            finger_forces=(0.0, 0.0),
        )

    return make


@pytest.fixture
def random_posture(panda):
    """A random posture well inside the joint limits."""
    low = np.array([joint.lower.value for joint in panda.joints]) + 0.15
    high = np.array([joint.upper.value for joint in panda.joints]) - 0.15
    return lambda rng: rng.uniform(low, high)
