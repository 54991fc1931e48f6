"""Environments with the names, the time steps and the actions of Fetch and metaworld, and an arm of capsules."""

import gymnasium
import mujoco
import numpy as np

from dualbrain.simulation.environments.mocap.gymnasium_robotics import JOINTS

START = np.array([0.0, -0.8, 0.0, 1.4, 0.0, np.pi / 2 - 0.6, 0.0])
"""Joint positions [rad] at which the tool points downwards."""
SEGMENTS = ((0.0, 0.0, 0.1), (0.12, 0.0, 0.06), (0.22, 0, 0), (0.13, 0, 0), (0.2, 0, 0), (0.125, 0, 0), (0.14, 0, 0))
"""Place of each joint in the body before it [m]."""
AXES = ("0 0 1", "0 1 0", "1 0 0", "0 1 0", "1 0 0", "0 1 0", "1 0 0")
DOWN = np.array([1.0, 0.0, 1.0, 0.0]) / np.sqrt(2.0)
HEIGHT = 0.15
"""Height of the tool above the table at the start [m]."""

HAND = """
<body name="{tool}" pos="0.15 0 0"><geom type="box" size=".03 .06 .03" pos="-.03 0 0"/>
  <body name="right_finger" pos=".03 -.016 0"><joint type="slide" axis="0 -1 0" range="0 .05" damping="1000"/>
    <geom type="box" size=".03 .007 .013"/></body>
  <body name="left_finger" pos=".03 .016 0"><joint type="slide" axis="0 1 0" range="0 .05" damping="1000"/>
    <geom type="box" size=".03 .007 .013"/></body>
</body>"""
SCENE = """
<mujoco><compiler angle="radian"/><option timestep="{timestep}" gravity="0 0 0"/>
<default><joint damping="5" armature="0.01"/></default>
<worldbody>
  <body name="mocap" mocap="true"/>
  <body name="table"><geom name="table" type="box" size=".25 .5 .1"/></body>
  <body name="{thing}"><freejoint name="thing"/><geom name="thing" type="box" size=".02 .02 .02" density="1"/></body>
  {robot}
</worldbody>
<equality><weld body1="mocap" body2="{tool}" relpose="0 0 0 1 0 0 0"/></equality>
</mujoco>"""


def arm(joints, bodies, tool):
    """The MJCF of an arm from the body before its first joint, with a capsule on each link."""
    text = HAND.format(tool=tool)
    for k in range(6, -1, -1):
        end = SEGMENTS[k + 1] if k < 6 else (0.1, 0, 0)
        text = (
            f'<body name="{bodies[k]}" pos="{" ".join(map(str, SEGMENTS[k]))}">'
            f'<joint name="{joints[k]}" axis="{AXES[k]}" range="-3 3" limited="true"/>'
            f'<geom type="capsule" size=".04" fromto="0 0 0 {" ".join(map(str, end))}" density="300"/>{text}</body>'
        )
    return text


FETCH_ROBOT = """<body name="robot0:base_link" pos="0 0 .2">
<joint name="robot0:slide0" type="slide" axis="1 0 0" damping="1e11"/><geom type="cylinder" size=".2 .15"/>
<body name="robot0:torso_fixed_link"><geom type="box" size=".05 .05 .4" pos="0 0 .3"/></body>
<body name="robot0:estop_link"/><body name="robot0:laser_link"/>
<body name="robot0:torso_lift_link" pos="0 0 .4">
<joint name="robot0:torso_lift_joint" type="slide" axis="0 0 1" damping="1e7"/>
<geom type="box" size=".06 .06 .1"/>{arm}</body></body>"""
SAWYER_ROBOT = '<body name="base"><body name="right_arm_base_link" pos="0 0 .6">' + "{arm}</body></body>"
SAWYER_BODIES = tuple(f"right_l{k}" for k in range(7))


class MocapSuite(gymnasium.Env):
    """One suite; `torso_speed` [m/s] lifts the torso, as the simulation of Fetch does."""

    metadata = {"render_modes": []}  # noqa: RUF012  # gymnasium's own form

    def __init__(self, suite, torso_speed=0.0):
        self.suite, self._torso_speed = suite, torso_speed
        is_fetch = suite == "fetch"
        self.joints = (
            tuple(f"robot0:{name}_joint" for name in JOINTS) if is_fetch else tuple(f"right_j{k}" for k in range(7))
        )
        bodies = tuple(f"robot0:{name}_link" for name in JOINTS) if is_fetch else SAWYER_BODIES
        self.tool, thing = ("robot0:gripper_link", "object0") if is_fetch else ("hand", "obj")
        self._n_substeps, timestep = (20, 0.002) if is_fetch else (5, 0.0025)
        robot = (FETCH_ROBOT if is_fetch else SAWYER_ROBOT).format(arm=arm(self.joints, bodies, self.tool))
        self.model = mujoco.MjModel.from_xml_string(
            SCENE.format(timestep=timestep, thing=thing, robot=robot, tool=self.tool)
        )
        self.data, self.dt = mujoco.MjData(self.model), self._n_substeps * timestep
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (4,), np.float32)
        self.observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float64)
        self._start()
        start = self.data.body(self.tool).xpos
        self.mocap_low, self.mocap_high = start - 0.4, start + 0.4
        self.model.body("table").pos[:] = start + np.array([0.0, 0.0, -HEIGHT - 0.1])
        self.top = float(start[2]) - HEIGHT

    def _start(self):
        mujoco.mj_resetData(self.model, self.data)
        for name, value in zip(self.joints, START, strict=True):
            self.data.joint(name).qpos[0] = value
        mujoco.mj_kinematics(self.model, self.data)
        tool = self.data.body(self.tool).xpos.copy()
        self.data.joint("thing").qpos[:3] = (3.0, 3.0, 0.0)
        self.data.mocap_pos[0], self.data.mocap_quat[0] = tool, DOWN
        mujoco.mj_forward(self.model, self.data)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self._start()
        return np.zeros(1), {}

    def step(self, action):
        shift = np.clip(np.asarray(action, float)[:3], -1.0, 1.0)
        if self.suite == "fetch":
            self.data.mocap_pos[0] = self.data.body(self.tool).xpos + 0.05 * shift
            torso = self.model.joint("robot0:torso_lift_joint")
            for _ in range(self._n_substeps):
                self.data.qpos[torso.qposadr[0]] += self._torso_speed * self.model.opt.timestep
                mujoco.mj_step(self.model, self.data)
        else:
            self.data.mocap_pos[0] = np.clip(self.data.mocap_pos[0] + 0.01 * shift, self.mocap_low, self.mocap_high)
            mujoco.mj_step(self.model, self.data, nstep=self._n_substeps)
        self.data.mocap_quat[0] = DOWN
        mujoco.mj_forward(self.model, self.data)
        return np.zeros(1), 0.0, False, False, {}

    def touches(self, geom="table"):
        """Whether the arm touches a geom."""
        other = self.model.geom(geom).id
        pairs = [set(map(int, contact.geom)) for contact in self.data.contact if contact.dist < 0.0]
        return any(other in pair and self.model.geom("thing").id not in pair - {other} for pair in pairs)
