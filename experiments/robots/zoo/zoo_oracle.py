"""Kinematics and Jacobians of an imported robot, compared with Pinocchio's, which reads the same description."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.robots.importer.kinematic_chain import KinematicChain, find_chain
from dualbrain.robots.importer.kinematic_tree import KinematicTree
from dualbrain.robots.model import RobotModel
from dualbrain.safety.cbf.filter import FilterConfig, SafetyFilter
from experiments.robots.zoo.zoo_robots import ZooRobot, import_pinocchio, robots_folder

Array = NDArray[np.float64]


def compare_kinematics(
    robot: ZooRobot, tree: KinematicTree, robot_model: RobotModel, states: int, rng: np.random.Generator
) -> tuple[float, float]:
    """Largest difference of the tool's pose and Jacobian over random states, by entry, with the float64 kernel."""
    safety = SafetyFilter(robot_model, FilterConfig(precision="float64"))
    return _compare_mobile_base(safety, states, rng) if robot.mobile else _compare_arm(robot, tree, safety, states, rng)


def _compare_arm(
    robot: ZooRobot, tree: KinematicTree, safety: SafetyFilter, states: int, rng: np.random.Generator
) -> tuple[float, float]:
    pin, chain = import_pinocchio(), find_chain(tree, base=robot.base, tip=robot.tip, lock=robot.lock)
    model = pin.buildModelFromUrdf(str(robots_folder() / robot.file))
    data = model.createData()
    base, tip = (model.getFrameId(name) for name in (chain.base, chain.tip))
    names = [joint.name for joint in chain.joints]
    columns = [model.joints[model.getJointId(name)].idx_v for name in names]
    pose_off = jacobian_off = 0.0
    for _ in range(states):
        q = np.array(
            [
                rng.uniform(max(joint.lower.value, -7.0), min(joint.upper.value, 7.0))
                for joint in safety.robot_model.joints
            ]
        )
        full = _full_configuration(pin, model, chain, dict(zip(names, q, strict=True)))
        pin.computeJointJacobians(model, data, full)
        pin.updateFramePlacements(model, data)
        in_base = data.oMf[base].inverse() * data.oMf[tip]
        turn = data.oMf[base].rotation.T
        J = pin.getFrameJacobian(model, data, tip, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:, columns]
        ours = safety.tool(q)
        pose_off = max(
            pose_off,
            float(np.abs(ours.position - in_base.translation).max()),
            float(np.abs(ours.rotation - in_base.rotation).max()),
        )
        jacobian_off = max(jacobian_off, float(np.abs(ours.jacobian - np.vstack([turn @ J[:3], turn @ J[3:]])).max()))
    return pose_off, jacobian_off


def _full_configuration(pin: Any, model: Any, chain: KinematicChain, values: dict[str, float]) -> Array:
    """Pinocchio's configuration with the chain's joints at `values` and the locked joints at their positions."""
    q = pin.neutral(model)
    for name, value in {**chain.locked, **values}.items():
        joint = model.joints[model.getJointId(name)]
        if joint.nq == 2:
            q[joint.idx_q : joint.idx_q + 2] = np.cos(value), np.sin(value)
        elif joint.nq == 1:
            q[joint.idx_q] = value
    return q


def _compare_mobile_base(safety: SafetyFilter, states: int, rng: np.random.Generator) -> tuple[float, float]:
    """Compare with a planar joint without its sideways column, which is a base with two driven wheels."""
    pin = import_pinocchio()
    model = pin.Model()
    joint = model.addJoint(0, pin.JointModelPlanar(), pin.SE3.Identity(), "base")
    data = model.createData()
    pose_off = jacobian_off = 0.0
    for _ in range(states):
        q = np.array([*rng.uniform(-5.0, 5.0, 2), rng.uniform(-np.pi, np.pi)])
        pin.computeJointJacobians(model, data, np.array([q[0], q[1], np.cos(q[2]), np.sin(q[2])]))
        J = pin.getJointJacobian(model, data, joint, pin.ReferenceFrame.LOCAL_WORLD_ALIGNED)[:, [0, 2]]
        ours = safety.tool(q)
        pose_off = max(
            pose_off,
            float(np.abs(ours.position - data.oMi[joint].translation).max()),
            float(np.abs(ours.rotation - data.oMi[joint].rotation).max()),
        )
        jacobian_off = max(jacobian_off, float(np.abs(ours.jacobian - J).max()))
    return pose_off, jacobian_off
