"""Scripted arm motions for tests: inverse kinematics with the simulator's Jacobian, and a joint-space servo."""

import mujoco
import numpy as np

from dualbrain.robots.interface import Command
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.plant.plant import Plant
from dualbrain.simulation.scenes.generators.tabletop import make_scene

PANDA = load_robot("panda")
HOME = np.array(PANDA.home)


def make_plant(family="bare", seed=0, **options):
    return Plant(make_scene(family, seed), PANDA, **options)


def yaw_of(pose):
    w, _, _, z = pose.quaternion
    return 2.0 * np.arctan2(z, w)


def top_down_posture(p, position, yaw):
    """Joint positions (7,) that put the tool at `position`, pointing down, with the fingers along y of `yaw`."""
    model, data = p.model, mujoco.MjData(p.model)
    data.qpos[:] = p.data.qpos
    arm, dofs = p.arm_slices
    site, jacobian = model.site("robot/tcp").id, np.zeros((6, model.nv))
    c, s = np.cos(yaw), np.sin(yaw)
    goal, q = np.array([[c, s, 0], [s, -c, 0], [0, 0, -1.0]]), HOME.copy()
    q[0] = np.arctan2(position[1], position[0])
    for _ in range(100):
        data.qpos[arm] = q
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        mujoco.mj_jacSite(model, data, jacobian[:3], jacobian[3:], site)
        now = data.site_xmat[site].reshape(3, 3)
        turn = 0.5 * sum(np.cross(now[:, k], goal[:, k]) for k in range(3))
        error = np.r_[np.asarray(position) - data.site_xpos[site], turn]
        J = jacobian[:, dofs]
        q = q + J.T @ np.linalg.solve(J @ J.T + 1e-4 * np.eye(6), error)
    assert np.linalg.norm(error) < 1e-4, "out of reach"
    return q


def servo_to(p, q, seconds, *, opening=0.04, force=20.0, speed=0.35, each=None):
    """Move to `q` with proportional joint velocities; `each` is called after every control period."""
    for _ in range(int(seconds * 1000)):
        u = np.clip(6.0 * (q - p.read().q), -speed, speed)
        p.write(Command(u, opening, force))
        p.advance()
        if each is not None:
            each()


def wait(p, seconds, each=None):
    for _ in range(int(seconds * 1000)):
        p.advance()
        if each is not None:
            each()


def pick_up(p, name, *, force=20.0, each=None):
    """Grasp an object from above and lift it by 15 cm, by contact alone."""
    pose = p.true_pose(name)
    at, yaw = np.array(pose.position), yaw_of(pose)
    above = top_down_posture(p, np.add(at, [0, 0, 0.12]), yaw)
    grasp = top_down_posture(p, np.add(at, [0, 0, 0.004]), yaw)
    servo_to(p, above, 1.6, force=force, each=each)
    servo_to(p, grasp, 1.0, force=force, each=each)
    servo_to(p, grasp, 0.6, opening=0.0, force=force, each=each)
    servo_to(p, top_down_posture(p, np.add(at, [0, 0, 0.15]), yaw), 1.3, opening=0.0, force=force, each=each)
