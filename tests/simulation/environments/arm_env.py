"""An environment as another suite would have it: a Panda on a turned mount among geoms of every type, in MuJoCo."""

import gymnasium
import mujoco
import numpy as np

from dualbrain.robots.loader import load_robot
from dualbrain.simulation.models.mujoco_model import load_mujoco_model

JOINTS = tuple(f"arm/joint{k}" for k in range(1, 8))
BASE = "arm/link0"
HOME = np.array(load_robot("panda").home)
MOUNT_POSITION, MOUNT_TURN = np.array([1.0, 2.0, 0.6]), np.pi / 3.0
PROBE_RADIUS = 1e-3
TETRAHEDRON = np.array([[0.0, 0.0, 0.0], [0.2, 0.0, 0.0], [0.0, 0.15, 0.0], [0.05, 0.05, 0.12]])


class ArmEnv(gymnasium.Env):
    """Joint velocities, executed exactly at 200 Hz; the observation is of no use to a filter."""

    metadata = {"render_modes": []}  # noqa: RUF012  # gymnasium's own form
    dt = 0.005

    def __init__(self, *, rebuilt=False):
        self.action_space = gymnasium.spaces.Box(-3.0, 3.0, (8,), np.float64)
        self.observation_space = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float64)
        self.rebuilt = rebuilt
        self._build()

    def _build(self):
        self.model = build_model()
        self.data = mujoco.MjData(self.model)

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        if self.rebuilt:
            self._build()
        mujoco.mj_resetData(self.model, self.data)
        self.set_posture(HOME)
        self._forward()
        return np.zeros(1), {}

    def step(self, action):
        q = self.posture + self.dt * action[:7]
        self.set_posture(q)
        self.data.qvel[self._dofs] = action[:7]
        ball = self.model.joint("swing")
        self.data.qpos[ball.qposadr[0]] += self.dt * self.data.qvel[ball.dofadr[0]]
        self._forward()
        return np.zeros(1), 0.0, False, False, {}

    def swing(self, speed):
        """Let the box on its hinge turn at `speed` [rad/s]."""
        self.data.qvel[self.model.joint("swing").dofadr[0]] = speed
        self._forward()

    @property
    def posture(self):
        return self.data.qpos[[self.model.joint(name).qposadr[0] for name in JOINTS]].copy()

    def set_posture(self, q):
        for name, value in zip(JOINTS, q, strict=True):
            self.data.qpos[self.model.joint(name).qposadr[0]] = value

    @property
    def _dofs(self):
        return [self.model.joint(name).dofadr[0] for name in JOINTS]

    def _forward(self):
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)
        mujoco.mj_comVel(self.model, self.data)


def build_model():
    root = mujoco.MjSpec()
    kinds, world = mujoco.mjtGeom, root.worldbody
    root.add_mesh(name="rock", uservert=TETRAHEDRON.ravel().tolist())
    half = MOUNT_TURN / 2.0
    mount = world.add_frame(pos=MOUNT_POSITION.tolist(), quat=[np.cos(half), 0.0, 0.0, np.sin(half)])
    mount.attach_body(load_mujoco_model("panda").root, "arm/", "")

    def place(x, y, z):
        c, s = np.cos(MOUNT_TURN), np.sin(MOUNT_TURN)
        return [MOUNT_POSITION[0] + c * x - s * y, MOUNT_POSITION[1] + s * x + c * y, MOUNT_POSITION[2] + z]

    turned = [0.8, 0.6, 0.0, 0.0]
    world.add_geom(name="table", type=kinds.mjGEOM_PLANE, size=[0, 0, 1], pos=[0.0, 0.0, 0.59])
    for name, kind, size, where in (
        ("ball", kinds.mjGEOM_SPHERE, [0.08, 0, 0], (0.5, 0.3, 0.3)),
        ("post", kinds.mjGEOM_CAPSULE, [0.04, 0.2, 0], (0.4, -0.4, 0.3)),
        ("crate", kinds.mjGEOM_BOX, [0.1, 0.15, 0.05], (0.65, 0.0, 0.15)),
        ("can", kinds.mjGEOM_CYLINDER, [0.05, 0.1, 0], (-0.5, 0.3, 0.2)),
        ("egg", kinds.mjGEOM_ELLIPSOID, [0.05, 0.08, 0.1], (-0.5, -0.3, 0.3)),
    ):
        world.add_geom(name=name, type=kind, size=size, pos=place(*where), quat=turned)
    world.add_geom(name="stone", type=kinds.mjGEOM_MESH, meshname="rock", pos=place(0.0, 0.6, 0.4), quat=turned)
    world.add_geom(
        name="backdrop", type=kinds.mjGEOM_BOX, size=[1.0, 1.0, 1.0], pos=place(0.3, 0, 0.5), contype=0, conaffinity=0
    )
    swinging_panel = world.add_body(name="swinging_panel", pos=place(0.0, -0.6, 0.3))
    swinging_panel.add_joint(name="swing", axis=[0.0, 0.0, 1.0])
    swinging_panel.add_geom(name="panel", type=kinds.mjGEOM_BOX, size=[0.02, 0.1, 0.2], pos=[0.0, 0.1, 0.0])
    probe = world.add_body(name="probe", mocap=True)
    probe.add_geom(name="probe", type=kinds.mjGEOM_SPHERE, size=[PROBE_RADIUS, 0, 0], contype=0, conaffinity=0)
    return root.compile()
