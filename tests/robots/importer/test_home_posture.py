"""A requested home posture is kept within the limits of the joints."""

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.robots.importer.home_posture import find_home_posture
from dualbrain.robots.importer.required_limits import CONTINUOUS_JOINT_RANGE
from dualbrain.robots.model import Bound, Joint, SelfCollisionPairs


def joint(name, end):
    rate = Bound(1.0, "rad/s", "test")
    return Joint(
        name=name,
        translation=(0.0, 0.0, 0.1),
        quaternion=(1.0, 0.0, 0.0, 0.0),
        lower=Bound(-end, "rad", "test"),
        upper=Bound(end, "rad", "test"),
        velocity=rate,
        acceleration=rate,
    )


JOINTS = (joint("turret", CONTINUOUS_JOINT_RANGE), joint("elbow", 2.0))


def find_home(requested):
    return find_home_posture(JOINTS, (), {}, SelfCollisionPairs((), ()), requested, 0.0, np.random.default_rng(0))


@pytest.mark.parametrize("home", [(4.0, 1.0), (-49.0, -1.9)])
def test_a_continuous_joint_may_have_its_home_beyond_half_a_turn(home):
    assert find_home(home).posture == home


@pytest.mark.parametrize(
    ("home", "match"),
    [
        ((51.0, 0.0), r"home of joint 'turret': got 51\.0, allowed: between -50 and 50 rad"),
        ((0.0, float("nan")), "home of joint 'elbow': got nan"),
        ((0.0, 2.0), "home of joint 'elbow'"),
        ((0.0,), "2 values within the joint limits"),
    ],
)
def test_a_home_outside_the_joint_limits_is_refused(home, match):
    with pytest.raises(ConfigurationError, match=match):
        find_home(home)


def test_a_home_is_searched_within_half_a_turn_of_a_continuous_joint():
    assert all(abs(value) < np.pi for value in find_home(None).posture)
