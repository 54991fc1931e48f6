"""A stand-in for robosuite's `Lift`: its interface, around a Panda with torque motors, a table, a crate and a cube."""

from types import SimpleNamespace

import mujoco
import numpy as np

from dualbrain.robots.loader import load_robot
from dualbrain.simulation.models.mujoco_model import load_mujoco_model

HOME = np.array(load_robot("panda").home)
JOINTS = [f"arm/joint{k}" for k in range(1, 8)]
STEPS = 25
"""Steps of the physics in one step of the environment."""


class PandaGripper:
    """robosuite's name of the gripper."""


class Lift:
    """Joint positions relative to the measured ones, by a PD controller at 500 Hz; the last entry is of the gripper."""

    model_timestep = 0.002
    action_dim = 8

    def __init__(self, *, crate_at=(0.55, 0.25)):
        self.crate_at, self.received, self.torques = crate_at, [], []
        self.cube = SimpleNamespace(root_body="cube_main")
        self.reset()

    def reset(self):
        model = build_model(self.crate_at)
        data = mujoco.MjData(model)
        data.qpos[[model.joint(name).qposadr[0] for name in JOINTS]] = HOME
        mujoco.mj_forward(model, data)
        self.sim = SimpleNamespace(model=SimpleNamespace(_model=model), data=SimpleNamespace(_data=data))
        self.motors = [model.actuator(f"motor{k}").id for k in range(7)]
        self.dofs = [model.joint(name).dofadr[0] for name in JOINTS]
        self.positions = [model.joint(name).qposadr[0] for name in JOINTS]
        self.robots = [
            SimpleNamespace(
                name="Panda",
                arms=["right"],
                gripper={"right": PandaGripper()},
                part_controllers={"right": SimpleNamespace(name="JOINT_POSITION")},
                robot_model=SimpleNamespace(naming_prefix="arm/", arm_joints=JOINTS),
                _ref_arm_joint_actuator_indexes=self.motors,
                _action_split_indexes={"right": (0, 7), "right_gripper": (7, 8)},
            )
        ]
        self.goal = HOME
        return {"q": HOME}

    def step(self, action):
        self.received.append(action)
        model, data = self.sim.model._model, self.sim.data._data
        for k in range(STEPS):
            mujoco.mj_step1(model, data)
            self._pre_action(action, k == 0)
            self.torques.append(data.ctrl[self.motors].copy())
            mujoco.mj_step2(model, data)
        return {"q": self.q}, 0.5, False, {"own": 1}

    def _pre_action(self, action, policy_step=False):
        data = self.sim.data._data
        if policy_step:
            self.goal = self.q + 0.4 * np.asarray(action)[:7]
        acceleration = 100.0 * (self.goal - self.q) - 20.0 * self.v
        data.ctrl[self.motors] = acceleration + data.qfrc_bias[self.dofs] - data.qfrc_passive[self.dofs]

    def _check_success(self):
        return False

    @property
    def q(self):
        return self.sim.data._data.qpos[self.positions].copy()

    @property
    def v(self):
        return self.sim.data._data.qvel[self.dofs].copy()

    def contacts(self):
        """Pairs of bodies, one of the arm and one that is neither of the arm nor the cube."""
        model, data = self.sim.model._model, self.sim.data._data
        found = set()
        for k in range(data.ncon):
            names = [model.body(int(model.geom_bodyid[geom])).name for geom in data.contact[k].geom]
            if sum(name.startswith("arm/") for name in names) == 1 and "cube_main" not in names:
                found.add(tuple(sorted(names)))
        return found


def build_model(crate_at):
    root = mujoco.MjSpec()
    kinds, world = mujoco.mjtGeom, root.worldbody
    root.option.timestep = Lift.model_timestep
    world.add_frame(pos=[0.1, 0.0, 0.5]).attach_body(load_mujoco_model("panda").root, "arm/", "")
    for actuator in list(root.actuators):
        root.delete(actuator)
    for k, joint in enumerate(JOINTS):
        motor = root.add_actuator(name=f"motor{k}", target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        motor.ctrlrange, motor.ctrllimited = [-87.0, 87.0], True
    world.add_geom(name="table", type=kinds.mjGEOM_PLANE, size=[0, 0, 1], pos=[0.0, 0.0, 0.48])
    crate = world.add_body(name="crate", pos=[0.1 + crate_at[0], crate_at[1], 0.7])
    crate.add_geom(name="crate", type=kinds.mjGEOM_BOX, size=[0.1, 0.1, 0.2])
    cube = world.add_body(name="cube_main", pos=[0.65, -0.2, 0.5])
    cube.add_freejoint()
    cube.add_geom(name="cube", type=kinds.mjGEOM_BOX, size=[0.02, 0.02, 0.02], mass=0.1)
    return root.compile()
