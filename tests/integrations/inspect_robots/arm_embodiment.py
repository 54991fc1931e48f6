"""An embodiment whose joints follow every action exactly: a Panda with a gripper, in any joint control mode."""

from dataclasses import replace
from math import degrees

import numpy as np
from inspect_robots.embodiment import EmbodimentInfo
from inspect_robots.spaces import ActionSemantics, Box, ObservationSpace, StateField, StateSpec
from inspect_robots.types import Observation, StepResult

from dualbrain import load_robot

PANDA = load_robot("panda")
HOME = np.array(PANDA.home)
LABELS = (*(joint.name for joint in PANDA.joints), "gripper")
RATE = 20.0
OPEN = 1.0


class ArmEmbodiment:
    """State: joint positions `q` (7,), velocities `v` (7,), and the gripper; `observation` makes the next observation.

    `stamped`: observations have the time of the episode; `unit` is that of actions and state.
    """

    def __init__(self, mode="joint_pos", *, labels=LABELS, unit="rad", stamped=True, simulated=True, rate=RATE):
        self.info = EmbodimentInfo(
            name="arm",
            action_space=Box(
                shape=(8,),
                low=np.full(8, -10.0),
                high=np.full(8, 10.0),
                semantics=ActionSemantics(control_mode=mode, gripper="continuous", dim_labels=labels),
            ),
            observation_space=ObservationSpace(state=StateSpec((StateField("joint_pos", (8,), f"{unit}+normalized"),))),
            control_hz=rate,
            is_simulated=simulated,
        )
        self.mode, self.stamped, self.scale = mode, stamped, degrees(1.0) if unit == "deg" else 1.0
        self.path = []
        self.closed = False

    def reset(self, scene, *, seed=None):
        del scene, seed
        self.q, self.v, self.gripper, self.time = HOME.copy(), np.zeros(7), OPEN, 0.0
        self.path = [self.q]
        return self.observation()

    def step(self, action):
        values = np.asarray(action.data, float)[:7] / self.scale
        before, self.gripper = self.q, float(action.data[7])
        if self.mode == "joint_pos":
            self.q = values
        else:
            self.q = self.q + values * (1.0 if self.mode == "joint_delta" else 1.0 / RATE)
        self.v, self.time = (self.q - before) * RATE, self.time + 1.0 / RATE
        self.path.append(self.q)
        return StepResult(observation=self.observation())

    def observation(self, **changes):
        state = {"joint_pos": np.append(self.q * self.scale, self.gripper)}
        found = Observation(state=state, state_time=1000.0 + self.time if self.stamped else 0.0)
        return replace(found, **changes)

    def close(self):
        self.closed = True

    def bind_task(self, envelope):
        self.envelope = envelope
