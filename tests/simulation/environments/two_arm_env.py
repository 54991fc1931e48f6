"""Two arms as gym-aloha has them, with the spheres of the robot model as geoms: joint positions, executed exactly."""

from types import SimpleNamespace

import gymnasium
import mujoco
import numpy as np

from dualbrain.robots.loader import load_robot

VX300S = load_robot("vx300s")
SIDES = ("left", "right")
HOME = np.array(VX300S.home)
BASES = {"left": ((-0.469, 0.5, 0.0), (1.0, 0.0, 0.0, 0.0)), "right": ((0.469, 0.5, 0.0), (0.0, 0.0, 0.0, 1.0))}
"""Positions [m] and orientations of the bases of gym-aloha."""
ENTRIES = {"left": slice(0, 6), "right": slice(7, 13)}
GRIPPERS = [6, 13]
STEP_TIME = 0.02


class TwoArmEnv(gymnasium.Env):
    """The arms move to the commanded positions within one step of 20 ms; the observation is of no use."""

    metadata = {"render_modes": []}  # noqa: RUF012  # gymnasium's own form

    def __init__(self, *, servo_range=None):
        """With `servo_range` [rad] the elbows have position servos, which MuJoCo would clip to it."""
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (14,), np.float32)
        self.observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float64)
        self.model = build_model(servo_range)
        self.data = mujoco.MjData(self.model)
        physics = SimpleNamespace(model=SimpleNamespace(ptr=self.model), data=SimpleNamespace(ptr=self.data))
        self._env = SimpleNamespace(physics=physics, control_timestep=lambda: STEP_TIME)
        self.geoms = {
            side: [g for g in range(self.model.ngeom) if self.model.geom(g).name.startswith(f"{side}/")]
            for side in SIDES
        }
        names = [self.model.geom(g).name for g in range(self.model.ngeom)]
        self.hand = [any(part in name for part in ("gripper", "fingers")) for name in names]

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        mujoco.mj_resetData(self.model, self.data)
        self.execute(home_action(), moving=False)
        return np.zeros(1), {}

    def step(self, action):
        self.execute(action)
        return np.zeros(1), 0.0, False, False, {}

    def execute(self, action, *, moving=True):
        for side in SIDES:
            for joint, value in zip(VX300S.joints, action[ENTRIES[side]], strict=True):
                found = self.model.joint(f"vx300s_{side}/{joint.name}")
                q = self.data.qpos[found.qposadr[0]]
                self.data.qvel[found.dofadr[0]] = (value - q) / STEP_TIME if moving else 0.0
                self.data.qpos[found.qposadr[0]] = value
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_comVel(self.model, self.data)

    def posture(self, side):
        return np.array([self.data.qpos[self.model.joint(f"vx300s_{side}/{j.name}").qposadr[0]] for j in VX300S.joints])

    def arm_distance(self, *, hands=True):
        """The least distance of the moving parts of both arms, or of those of which one is no hand [m]."""
        left, right = (np.array(self.geoms[side]) for side in SIDES)
        place, radius = self.data.geom_xpos, self.model.geom_size[:, 0]
        apart = np.linalg.norm(place[left][:, None] - place[right], axis=2) - radius[left][:, None] - radius[right]
        guarded = np.array([[hands or not (self._is_hand(a) and self._is_hand(b)) for b in right] for a in left])
        return float(apart[guarded].min())

    def table_distance(self, *, hands=True):
        """The least distance of an arm, without its shoulder, from the table [m]."""
        return min(
            self.data.geom_xpos[g][2] - self.model.geom_size[g][0]
            for side in SIDES
            for g in self.geoms[side]
            if (hands or not self._is_hand(g)) and "shoulder" not in self.model.geom(g).name
        )

    def _is_hand(self, geom):
        return self.hand[geom]


def home_action():
    return np.concatenate([HOME, [0.5], HOME, [0.5]])


def build_model(servo_range=None):
    spec, kinds = mujoco.MjSpec(), mujoco.mjtGeom
    world = spec.worldbody
    table = world.add_body(name="table")
    table.add_geom(name="table", type=kinds.mjGEOM_BOX, size=[0.6, 0.4, 0.01], pos=[0.0, 0.6, -0.01])
    cube = world.add_body(name="box", pos=[0.0, 0.5, 0.1])
    cube.add_freejoint(name="red_box_joint")
    cube.add_geom(name="red_box", type=kinds.mjGEOM_BOX, size=[0.02, 0.02, 0.02])
    for side in SIDES:
        position, quaternion = BASES[side]
        body = world.add_body(name=f"vx300s_{side}", pos=position, quat=quaternion)
        for frame, joint in enumerate(VX300S.joints, start=1):
            body = body.add_body(
                name=f"vx300s_{side}/frame{frame}", pos=list(joint.translation), quat=list(joint.quaternion)
            )
            body.add_joint(name=f"vx300s_{side}/{joint.name}", axis=[0.0, 0.0, 1.0])
            for link in VX300S.links:
                spheres = [sphere for sphere in VX300S.spheres if sphere.link == link.name and link.frame == frame]
                for k, sphere in enumerate(spheres):
                    body.add_geom(
                        name=f"{side}/{link.name}/{k}",
                        type=kinds.mjGEOM_SPHERE,
                        size=[sphere.radius, 0.0, 0.0],
                        pos=list(sphere.centre),
                    )
        if servo_range is not None:
            servo = spec.add_actuator(name=f"{side}/elbow", target=f"vx300s_{side}/elbow")
            servo.trntype, servo.ctrlrange = mujoco.mjtTrn.mjTRN_JOINT, servo_range
            servo.set_to_position(kp=800.0)
    return spec.compile()
