"""Write vectors/filter_step.json: recorded steps of the filter, to be reproduced bit for bit on every target.

Run `python -m tests.safety.kernel.step_vectors` only after an intended change of the kernel's arithmetic or of the
Panda model.
"""

from pathlib import Path

import msgspec
import numpy as np

from dualbrain.core.geometry.shapes import Box, HalfSpace, Pose, Sphere
from dualbrain.robots.interface import RobotState
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import Contact, FilterConfig, Obstacle, SafetyFilter

FILE = Path(__file__).resolve().parents[3] / "vectors" / "filter_step.json"


class Step(msgspec.Struct):
    """Inputs of one step, and its result."""

    t: float
    q: list[float]
    v: list[float]
    u_nom: list[float]
    opening: float
    u: list[float] = []
    status: int = 0
    delta: float = 0.0
    h_min: float = 0.0


class Recording(msgspec.Struct):
    """A closed loop: the inputs of the filter, then every step."""

    robot: str
    config: FilterConfig
    obstacles: list[Obstacle]
    permits: list[Contact]
    steps: list[Step]


def build_filter(recording):
    """The filter of a recording."""
    safety = SafetyFilter(load_robot(recording.robot), recording.config)
    safety.observe(recording.obstacles, 0.0)
    safety.permit(recording.permits)
    return safety


def run_step(safety, step):
    """Repeat one step."""
    state = RobotState(
        stamp=step.t, sequence=0, q=np.array(step.q), v=np.array(step.v), opening=step.opening, finger_forces=(0.0, 0.0)
    )
    return safety.filter(state, np.array(step.u_nom), step.t)


def record_vectors(steps=120):
    """A loop past a sphere, a box and the table, with a permit, in which lag and motion of the obstacle matter."""
    robot_model = load_robot("panda")
    recording = Recording(
        "panda",
        FilterConfig(),
        [
            Obstacle("table", HalfSpace(), Pose((0.0, 0.0, 0.0)), known=True),
            Obstacle("cube", Box((0.02, 0.02, 0.02)), Pose((0.5, 0.0, 0.3), (0.9, 0.1, 0.2, 0.3))),
            Obstacle(
                "ball",
                Sphere(0.05),
                Pose((0.75, 0.1, 0.4)),
                velocity=(-0.3, 0.0, 0.0),
                margin=0.005,
                velocity_error=0.02,
                static=False,
            ),
        ],
        [Contact("fingers", "cube", 0.05)],
        [],
    )
    safety, rng = build_filter(recording), np.random.default_rng(0)
    q, v = np.array(robot_model.home), np.zeros(7)
    for k in range(steps):
        if k % 40 == 0:
            desired = rng.choice([-1.0, 1.0], 7) * 2.0
        step = Step(k * 1e-3, q.tolist(), v.tolist(), np.clip(desired * k / 100, -2, 2).tolist(), 0.03)
        answer = run_step(safety, step)
        step.u, step.status = answer.u.tolist(), int(answer.status)
        step.delta, step.h_min = answer.delta, answer.h_min
        recording.steps.append(step)
        v = v + (answer.u - v) * 1e-3 / robot_model.tracking.lag
        q = q + 1e-3 * v
    return recording


if __name__ == "__main__":
    FILE.parent.mkdir(exist_ok=True)
    FILE.write_bytes(msgspec.json.encode(record_vectors()) + b"\n")
