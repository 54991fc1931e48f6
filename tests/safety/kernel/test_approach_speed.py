"""The speed of approach leaves room for a stop along the arc: s = min(α h, 2g h − C/(4g)), g = min a/v."""

import msgspec
import numpy as np
import pytest

from dualbrain.core.geometry.shapes import HalfSpace, Pose
from dualbrain.safety.cbf.filter import Obstacle, SafetyFilter
from tests.safety import geometry_oracle, random_scenes

FACING_OUTWARD = (np.sqrt(0.5), 0.0, np.sqrt(0.5), 0.0)
"""Orientation of a wall whose normal is the x axis."""


def turning_arm(body, rate):
    """Every joint takes 1/`rate` [s] to stop from its full speed; the hand has one sphere, in the plane of the arm."""

    def limited(joint):
        acceleration = msgspec.structs.replace(joint.acceleration, value=rate * joint.velocity.value)
        return msgspec.structs.replace(joint, acceleration=acceleration)

    centre, _, names = geometry_oracle.sphere_centres(body, np.array(body.home)[None])
    hand = [index for index, name in enumerate(names) if name == "hand"]
    kept = min(hand, key=lambda index: abs(centre[0, index, 1]))
    spheres = [sphere for sphere in body.spheres if sphere.link != "hand"]
    own = [sphere for sphere in body.spheres if sphere.link == "hand"][hand.index(kept)]
    return msgspec.structs.replace(body, joints=tuple(map(limited, body.joints)), spheres=(*spheres, own))


def hand_position(body, q):
    """Smallest x coordinate (t,) [m] of the surface of the hand's sphere."""
    centre, radius, names = geometry_oracle.sphere_centres(body, q)
    hand = names.index("hand")
    return centre[:, hand, 0] - radius[hand]


def stop_path(q, u, rate, period):
    """Postures (t, n) of a stop from `u` with the deceleration rate · v_max, from full speed."""
    steps = int(np.ceil(1.0 / (rate * period)))
    return q + period * np.cumsum(np.linspace(1.0, 0.0, steps + 1))[:, None] * u


@pytest.mark.parametrize("rate", [2.0, 3.0, 6.0])
@pytest.mark.parametrize(("share", "passes"), [(1.3, True), (0.7, False)])
def test_a_tangential_motion_passes_if_a_stop_along_its_arc_ends_outside(sparse_panda, state_at, rate, share, passes):
    """The hand moves along a wall, without approach, and its arc leads into the wall."""
    body = turning_arm(sparse_panda, rate)
    q, u = np.array(body.home), np.zeros(7)
    u[0] = body.joints[0].velocity.value
    start = hand_position(body, q[None])[0]
    loss = start - hand_position(body, stop_path(q, u, rate, body.period)).min()
    assert loss > 0.005
    wall_x = start - share * loss - 3e-4
    wall = Obstacle("wall", HalfSpace(), Pose((float(wall_x), 0.0, 0.0), FACING_OUTWARD), parts=("hand",))
    safety = SafetyFilter(body, random_scenes.exact_config(precision="float64"))
    safety.observe([wall], 0.0)
    safety.reset(u)
    answer = safety.filter(state_at(q, u), u, 0.0)
    assert np.allclose(answer.u, u, atol=1e-9) == passes
