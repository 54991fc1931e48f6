"""Servos of an SO-101 that follow their commands with a first-order lag, and a site with a table and a crate."""

import numpy as np

from dualbrain.core.geometry.shapes import Box, HalfSpace, Pose
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.config import operating_config
from dualbrain.safety.cbf.filter import SafetyFilter
from dualbrain.safety.cbf.obstacles import Obstacle
from dualbrain.safety.integration.servo_bus.guarded_servos import GuardedServos
from dualbrain.safety.integration.servo_bus.servo_map import ServoMap

SO101 = load_robot("so101")
NAMES = [joint.name for joint in SO101.joints]
KEYS = tuple(f"{name}.pos" for name in (*NAMES, "gripper"))
PERIOD = SO101.period
LAG = 0.03
"""Time constant of the servos [s]."""
OBSTACLES = (Obstacle("table", HalfSpace()), Obstacle("crate", Box((0.05, 0.05, 0.08)), Pose((0.2, 0.14, 0.08))))


def make_servos(obstacles=OBSTACLES, action_rate=30.0, **options):
    """Guarded servos of an SO-101."""
    safety = SafetyFilter(SO101, operating_config(SO101), obstacles=obstacles)
    return GuardedServos(safety, ServoMap.of(SO101, KEYS), action_period=1.0 / action_rate, **options)


def action(q, gripper=30.0):
    """An action with the joint positions `q` [rad]."""
    return dict(zip(KEYS, (*np.degrees(q).tolist(), gripper), strict=True))


class IdealServos:
    """State: positions (6,) [deg] in the order of KEYS, and everything that was written."""

    def __init__(self, q=SO101.home):
        self.values = np.array([*np.degrees(q), 30.0])
        self.goal = self.values.copy()
        self.written = []
        self.broken = ""

    def read(self):
        """Values by key."""
        if self.broken:
            raise ConnectionError(self.broken)
        return dict(zip(KEYS, self.values.tolist(), strict=True))

    def write(self, values):
        """Take a goal, and move for one period."""
        self.written.append(dict(values))
        self.goal = np.array([values.get(key, goal) for key, goal in zip(KEYS, self.goal, strict=True)])
        self.advance()

    def advance(self):
        """Move for one period."""
        self.values = self.values + (PERIOD / LAG) * (self.goal - self.values)

    @property
    def q(self):
        """Joint positions (5,) [rad]."""
        return np.radians(self.values[:5])
