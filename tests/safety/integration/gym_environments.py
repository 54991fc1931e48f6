"""Two small gymnasium environments with a Panda: kinematic with normalised velocities, and MuJoCo with torques."""

import gymnasium
import mujoco
import numpy as np

from dualbrain.core.geometry.shapes import Box, Capsule, HalfSpace, Pose
from dualbrain.robots.loader import load_robot
from dualbrain.safety.cbf.filter import FilterConfig, Obstacle, SafetyFilter
from dualbrain.safety.integration.derating import derate
from dualbrain.simulation.plant.plant import ARM_ACTUATOR_GROUP, Plant
from dualbrain.simulation.scenes.generators.tabletop import make_scene
from tests.safety import geometry_oracle

PERIOD = 0.005
PANDA = load_robot("panda")
DERATED_PANDA = derate(PANDA, period=PERIOD, max_speed=1.5)
V_MAX = np.array([joint.velocity.value for joint in DERATED_PANDA.joints])
MAX_TORQUE = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])
EXACT_CONFIG = FilterConfig(lag_compensation=False, tracking_error=0.0)
OBSTACLES = (
    Obstacle("table", HalfSpace(), Pose((0.0, 0.0, 0.0))),
    Obstacle("post", Capsule(0.04, 0.3), Pose((0.45, 0.35, 0.3))),
    Obstacle("shelf", Box((0.15, 0.25, 0.02)), Pose((0.6, -0.1, 0.2))),
)


class ReachEnv(gymnasium.Env):
    """Bring the tool to a point: joints follow the action exactly, q ← q + dt u, u = 1.5 rad/s times the action.

    Observation: q, v, goal. The episode ends at the goal, or after `length` steps.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  # gymnasium's own form
    dt = PERIOD

    def __init__(self, length=300):
        low = np.array([joint.lower.value for joint in PANDA.joints]) - 3.0
        high = np.array([joint.upper.value for joint in PANDA.joints]) + 3.0
        far = np.array([1.0, 1.0, 1.5])
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (7,), np.float32)
        self.observation_space = gymnasium.spaces.Box(
            np.concatenate([low, -V_MAX, -far]), np.concatenate([high, V_MAX, far]), dtype=np.float64
        )
        self._kinematics, self._length = SafetyFilter(DERATED_PANDA), length

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.q, self.v, self._steps = np.array(PANDA.home), np.zeros(7), 0
        self.goal = self.np_random.uniform([0.2, -0.5, 0.05], [0.7, 0.5, 0.8])
        return self._observation(), {}

    def step(self, action):
        self.v = np.clip(np.asarray(action, float), -1.0, 1.0) * V_MAX
        self.q = self.q + PERIOD * self.v
        self._steps += 1
        gap = float(np.linalg.norm(self._kinematics.tool(self.q).position - self.goal))
        return self._observation(), -gap, gap < 0.03, self._steps >= self._length, {}

    def _observation(self):
        return np.concatenate([self.q, self.v, self.goal])


class TorqueEnv(gymnasium.Env):
    """The simulated arm under joint torques [Nm] with gravity compensation; it provides its own dynamics for tracking.

    Observations are dictionaries of q and v. The velocity drives are off; MuJoCo integrates at 1 kHz.
    """

    metadata = {"render_modes": []}  # noqa: RUF012  # gymnasium's own form
    dt = 1e-3

    def __init__(self, length=2000):
        self.plant = Plant(make_scene("bare", 1), PANDA)
        self.plant.model.opt.disableactuator |= 1 << ARM_ACTUATOR_GROUP
        self.action_space = gymnasium.spaces.Box(-MAX_TORQUE, MAX_TORQUE, dtype=np.float64)
        wide = gymnasium.spaces.Box(-20.0, 20.0, (7,), np.float64)
        self.observation_space = gymnasium.spaces.Dict({"q": wide, "v": wide})
        self._length, self._joints = length, self.plant.arm_slices[1]
        self._model_data = mujoco.MjData(self.plant.model)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.plant.model, self.plant.data)
        self.plant.set_configuration(np.array(PANDA.home))
        self._steps = 0
        return self._observation(), {}

    def step(self, action):
        self.plant.data.qfrc_applied[self._joints] = np.clip(action, -MAX_TORQUE, MAX_TORQUE)
        self.plant.advance()
        self._steps += 1
        return self._observation(), 0.0, False, self._steps >= self._length, {}

    def _observation(self):
        state = self.plant.read()
        return {"q": state.q, "v": state.v}

    # --- dynamics ---------------------------------------------------------------------------------------------

    def acceleration(self, q, v, torque):
        mass, bias = self._dynamics(q, v)
        return np.linalg.solve(mass, torque - bias)

    def track(self, q, v, u):
        mass, bias = self._dynamics(q, v)
        return np.clip(mass @ (u - v) / self.dt + bias, -MAX_TORQUE, MAX_TORQUE)

    def _dynamics(self, q, v):
        """Mass matrix (7, 7) and bias (7,): Coriolis and gravity minus gravity compensation and damping."""
        model, data, arm = self.plant.model, self._model_data, self._joints
        data.qpos[:], data.qvel[:] = self.plant.data.qpos, 0.0
        data.qpos[self.plant.arm_slices[0]], data.qvel[arm] = q, v
        mujoco.mj_fwdPosition(model, data)
        mujoco.mj_fwdVelocity(model, data)
        full = np.zeros((model.nv, model.nv))
        mujoco.mj_fullM(model, data, full)
        return full[arm, arm], (data.qfrc_bias - data.qfrc_passive)[arm]


def make_filter(robot_model=DERATED_PANDA, obstacles=OBSTACLES, config=EXACT_CONFIG):
    safety = SafetyFilter(robot_model, config)
    safety.observe(obstacles)
    return safety


def min_h(q, obstacles=OBSTACLES, opening=0.0):
    """Smallest h of a path q (t, 7): obstacles [m], self-collision [m], joint limits [rad]; computed in float64."""
    q = np.asarray(q)
    parts = (
        geometry_oracle.h_obstacles(PANDA, q, obstacles, opening),
        geometry_oracle.h_self(PANDA, q, opening),
        geometry_oracle.h_joints(PANDA, q),
    )
    return min(h.min() for h in parts)
