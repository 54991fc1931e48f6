"""The suite's process: robosuite's Lift or Stack with its Panda, stepped by joint velocities through pipes.

`suite_process.py` runs it as `python -m experiments.robots.robosuite.worker` in the suite's environment, without
dualbrain. Physics, time step, objects, placement, torque controller and success check are robosuite's, unchanged. Its
JOINT_TORQUE controller adds the Coriolis and gravity torque; a velocity controller precedes it (computed torque;
Siciliano et al., Robotics, 8.5.2)

    τ = M(q) k (u − v) − p(q, v),    k = 1/(LAG + dt)

with the inertia M and the passive torque p. It has no integral term, so a load leaves a steady error.
"""

from __future__ import annotations

import os
import sys
from collections import defaultdict
from typing import Any

import mujoco
import numpy as np
import robosuite
from numpy.typing import NDArray
from robosuite import macros
from robosuite.controllers import load_composite_controller_config

from experiments.engine.pipe_protocol import PipeError, receive, send
from experiments.robots.robosuite.limit_monitor import LimitMonitor

Array = NDArray[np.float64]

LAG = 0.002
"""Lag of the velocity controller [s]."""
SHAPE_NAMES = {0: "plane", 5: "cylinder", 6: "box"}
"""MuJoCo's shape types in robosuite's tables, mounts and cubes."""
HORIZON = 1_000_000


class RobosuiteTask:
    """One task of robosuite, and the quantities read from its simulation."""

    def __init__(self, task: str, seed: int) -> None:
        """A new environment; its seed determines the cubes and the arm's start posture."""
        self.env = _environment(task, seed)
        self.model, self.data = self.env.sim.model._model, self.env.sim.data._data
        robot = self.env.robots[0]
        self._q, self._v = np.array(robot._ref_joint_pos_indexes), np.array(robot._ref_joint_vel_indexes)
        self._fingers = np.array(robot._ref_gripper_joint_pos_indexes["right"])
        self._dofs = np.ix_(self._v, self._v)
        self._site = robot.eef_site_id["right"]
        base = self.data.body(robot.robot_model.root_body)
        self._base_position, self._base_rotation = base.xpos.copy(), base.xmat.reshape(3, 3).copy()
        self._limits = self.model.actuator_ctrlrange[robot._ref_arm_joint_actuator_indexes, 1].copy()
        self._gain = 1.0 / (LAG + self.model.opt.timestep)
        self._inertia = np.zeros((self.model.nv, self.model.nv))
        self._part_names = [self._part_name(geom) for geom in range(self.model.ngeom)]
        self.cubes = sorted(name for name in set(self._part_names) if name.startswith("cube"))
        self._checked_pairs = self._pairs_to_check()
        self._limit_monitor, self._wrench = LimitMonitor(), np.zeros(6)
        self._steps = self._saturated = 0
        self._success = False
        self._first_success: float | None = None

    # --- answers ----------------------------------------------------------------------------------------------

    def setup(self) -> dict[str, Any]:
        """Period, cubes, all objects with their shapes in the arm's base frame, and the first state."""
        return {
            "period": float(self.model.opt.timestep),
            "cubes": self.cubes,
            "things": [self._object_of(geom) for geom in range(self.model.ngeom) if self._is_obstacle(geom)],
            "torques": self._limits.tolist(),
            "state": self.state().tolist(),
        }

    def grip_sites(self, postures: Array) -> list[list[float]]:
        """The suite's grip site at `postures` (k, 7): position and rotation matrix, 12 numbers, in the base frame."""
        scratch = mujoco.MjData(self.model)
        found = []
        for q in postures:
            scratch.qpos[:] = self.data.qpos
            scratch.qpos[self._q] = q
            mujoco.mj_kinematics(self.model, scratch)
            position = self._base_rotation.T @ (scratch.site_xpos[self._site] - self._base_position)
            rotation = self._base_rotation.T @ scratch.site_xmat[self._site].reshape(3, 3)
            found.append([*position.tolist(), *rotation.ravel().tolist()])
        return found

    def state(self) -> Array:
        """Time [s], q (7,), v (7,), finger opening [m], success, then position and quaternion of each cube."""
        opening = 0.5 * float(np.abs(self.data.qpos[self._fingers]).sum())
        poses = [number for name in self.cubes for number in self._pose(self.data.body(f"{name}_main"))]
        head = [self.data.time, *self.data.qpos[self._q], *self.data.qvel[self._v], opening, float(self._success)]
        return np.array([*head, *poses])

    def limit_report(self) -> dict[str, Any]:
        """Success, breaches and torque saturation up to now."""
        return {
            "success": bool(self.env._check_success()),
            "first_success": self._first_success,
            "breaches": self._limit_monitor.breaches(),
            "saturated": self._saturated / max(1, self._steps),
        }

    # --- one period -------------------------------------------------------------------------------------------

    def step(self, command: Array) -> Array:
        """Apply joint velocities command[:7] [rad/s], with the fingers closing if command[7] > 0; returns the state."""
        torque = self._torque(command[:7])
        _, reward, _, _ = self.env.step(np.r_[torque / self._limits, command[7]])
        self._success = reward > 0.0
        if self._success and self._first_success is None:
            self._first_success = round(self.data.time, 4)
        self._limit_monitor.update(
            self.data.time, self.data.qpos[self._q], self.data.qvel[self._v], self._contact_forces()
        )
        return self.state()

    def _torque(self, u: Array) -> Array:
        """The torque for the suite's controller, before that adds the bias torque and clips the sum."""
        data = self.data
        mujoco.mj_fullM(self.model, self._inertia, data.qM)
        torque = self._inertia[self._dofs] @ (self._gain * (u - data.qvel[self._v])) - data.qfrc_passive[self._v]
        self._steps += 1
        self._saturated += bool(np.any(np.abs(torque + data.qfrc_bias[self._v]) >= self._limits))
        return torque

    def _contact_forces(self) -> dict[tuple[str, str], float]:
        """Normal forces [N] between parts of the robot and parts that they must not touch."""
        found: dict[tuple[str, str], float] = defaultdict(float)
        pairs = self.data.contact.geom
        for index in np.flatnonzero(self._checked_pairs[pairs[:, 0], pairs[:, 1]]).tolist():
            mujoco.mj_contactForce(self.model, self.data, index, self._wrench)
            one, other = sorted(self._part_names[geom] for geom in pairs[index])
            found[one, other] += float(self._wrench[0])
        return found

    # --- the model --------------------------------------------------------------------------------------------

    def _part_name(self, geom: int) -> str:
        name = self.model.body(self.model.geom_bodyid[geom]).name
        if name.startswith("gripper0"):
            return "finger" if "finger" in name else "hand"
        if name.startswith("fixed_mount"):
            return "mount"
        return name.removeprefix("robot0_").removesuffix("_main").replace("world", "floor")

    def _pairs_to_check(self) -> NDArray[np.bool_]:
        """Pairs of geoms that must not touch: the robot with objects and itself, except fingers with the first cube."""
        robot = np.array([name.startswith(("link", "hand", "finger")) for name in self._part_names])
        finger = np.array([name == "finger" for name in self._part_names])
        target = np.array([name == self.cubes[0] for name in self._part_names])
        judged = robot[:, None] | robot
        allowed = (finger[:, None] & target) | (finger[:, None] & finger)
        return judged & ~(allowed | allowed.T)

    def _is_obstacle(self, geom: int) -> bool:
        """Whether a shape can have contacts and is no part of the arm."""
        collides = self.model.geom_contype[geom] or self.model.geom_conaffinity[geom]
        return bool(collides) and not self._part_names[geom].startswith(("link", "hand", "finger"))

    def _object_of(self, geom: int) -> dict[str, Any]:
        quaternion = np.zeros(4)
        turn = self._base_rotation.T @ self.data.geom_xmat[geom].reshape(3, 3)
        mujoco.mju_mat2Quat(quaternion, turn.ravel())
        return {
            "name": self._part_names[geom],
            "solid": SHAPE_NAMES[int(self.model.geom_type[geom])],
            "size": self.model.geom_size[geom].tolist(),
            "quaternion": quaternion.tolist(),
            "position": (self._base_rotation.T @ (self.data.geom_xpos[geom] - self._base_position)).tolist(),
        }

    def _pose(self, body: Any) -> list[float]:
        quaternion = np.zeros(4)
        mujoco.mju_mat2Quat(quaternion, (self._base_rotation.T @ body.xmat.reshape(3, 3)).ravel())
        return [*(self._base_rotation.T @ (body.xpos - self._base_position)).tolist(), *quaternion.tolist()]


def _environment(task: str, seed: int) -> Any:
    """An environment of robosuite at its own time step, with one action per physics step and without rendering."""
    config = load_composite_controller_config(robot="Panda")
    arm = config["body_parts"]["right"]
    limits = [80.0] * 5 + [12.0] * 2
    config["body_parts"]["right"] = {
        "type": "JOINT_TORQUE",
        "input_max": 1,
        "input_min": -1,
        "output_max": limits,
        "output_min": [-limit for limit in limits],
        "interpolation": None,
        "gripper": arm["gripper"],
    }
    env = robosuite.make(
        task,
        robots="Panda",
        controller_configs=config,
        has_renderer=False,
        has_offscreen_renderer=False,
        use_camera_obs=False,
        use_object_obs=False,
        control_freq=round(1.0 / macros.SIMULATION_TIMESTEP),
        horizon=HORIZON,
        ignore_done=True,
        seed=seed,
    )
    for name in env.observation_names:
        env.modify_observable(name, "enabled", False)
        env.modify_observable(name, "active", False)
    env.sim.forward()
    return env


def main() -> None:
    """Answer requests until the input ends; output of libraries goes to stderr."""
    answers = os.dup(1)
    os.dup2(2, 1)
    versions = {"robosuite": robosuite.__version__, "mujoco": mujoco.__version__, "numpy": np.__version__}
    send(answers, {"versions": versions})
    suite: RobosuiteTask | None = None
    while True:
        try:
            request = receive(0)
        except PipeError:
            return
        if not isinstance(request, dict):
            send(answers, suite.step(request))
        elif request["do"] == "open":
            if suite is not None:
                suite.env.close()
            suite = RobosuiteTask(request["task"], request["seed"])
            send(answers, suite.setup())
        elif request["do"] == "sites":
            send(answers, {"sites": suite.grip_sites(np.array(request["postures"]))})
        else:
            send(answers, suite.limit_report())


if __name__ == "__main__":
    sys.exit(main())
