"""Prints the SHA-256 of the controls of some thousand random filter calls: equal digests mean equal kernel bits.

    python filter_digest.py [CALLS]

The program imports only dualbrain and numpy, so that it runs in the environment of a wheel. The states are uniform
within the limits of each robot, from NumPy's PCG64, whose numbers are the same in every version.
"""

from __future__ import annotations

import hashlib
import sys
from collections.abc import Iterator

import numpy as np

from dualbrain import Box, Capsule, HalfSpace, Obstacle, Pose, RobotModel, SafetyFilter, Sphere, load_robot

ROBOTS = ("panda", "ur5e", "mobile_panda")
"""Robots of the small and of the large kernel."""
CALLS = 6000
TABLE = Obstacle("table", HalfSpace())
OBSTACLES = (
    Obstacle("post", Capsule(radius=0.03, half_length=0.2), Pose((0.5, 0.25, 0.2))),
    Obstacle("crate", Box((0.1, 0.15, 0.1)), Pose((0.45, -0.3, 0.1))),
    Obstacle("ball", Sphere(0.06), Pose((0.3, 0.1, 0.6))),
)


def digest(calls: int) -> str:
    """The SHA-256 of the controls and states of `calls` calls in equal parts for each robot."""
    state = hashlib.sha256()
    for name in ROBOTS:
        for part in random_calls(load_robot(name), calls // len(ROBOTS)):
            state.update(part)
    return state.hexdigest()


def random_calls(robot: RobotModel, calls: int) -> Iterator[bytes]:
    """The bytes of each control with its status."""
    source = np.random.default_rng(20261127)
    on_wheels = len(robot.home) != robot.n  # then q begins with the pose of the base, and the floor is no obstacle
    safety = SafetyFilter(robot, obstacles=[*OBSTACLES, *(() if on_wheels else (TABLE,))])
    lower, upper = (np.array([getattr(joint, end).value for joint in robot.joints]) for end in ("lower", "upper"))
    speed = np.array([joint.velocity.value for joint in robot.joints])
    for call in range(calls):
        joints = lower + (upper - lower) * source.random(robot.n)
        q = np.concatenate([source.random(3) - 1.5, joints[2:]]) if on_wheels else joints
        v, u_nom = (speed * (2.0 * source.random(robot.n) - 1.0) for _ in range(2))
        result = safety(q, v, u_nom=u_nom, now=call * robot.period)
        yield result.u.tobytes() + result.status.name.encode()


if __name__ == "__main__":
    sys.stdout.write(digest(int(sys.argv[1]) if sys.argv[1:] else CALLS) + "\n")
