"""View states of the sample run, with forward kinematics that are independent of the package."""

import msgspec
import numpy as np

from dualbrain.control.recording.trace import Trace
from dualbrain.core.geometry.rotations import matrix_to_quaternion, quaternion_to_matrix
from dualbrain.core.geometry.shapes import Pose
from dualbrain.records import Scene
from dualbrain.robots.model import RobotModel
from dualbrain.visualization.live.view_state import Array, ViewState


def _transform(translation: tuple[float, ...], turn: tuple[float, ...]) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = quaternion_to_matrix(turn), translation
    return T


def link_frames(robot_model: RobotModel, q: Array, opening: float) -> dict[str, Array]:
    """T_world_link (4, 4) by link name."""
    chain = [np.eye(4)]
    for joint, angle in zip(robot_model.joints, q, strict=True):
        turn = _transform((0, 0, 0), (np.cos(angle / 2), 0, 0, np.sin(angle / 2)))
        chain.append(chain[-1] @ _transform(joint.translation, joint.quaternion) @ turn)
    return {
        link.name: chain[link.frame]
        @ _transform(link.translation, link.quaternion)
        @ _transform(tuple(opening * np.array(link.slide)), (1, 0, 0, 0))
        for link in robot_model.links
    }


def view_state_at(robot_model: RobotModel, trace: Trace, scene: Scene, k: int) -> ViewState:
    """View state at tick `k`."""
    frames = link_frames(robot_model, trace["q"][k], float(trace["opening"][k]))
    spheres = robot_model.spheres
    centres = np.array([(frames[sphere.link] @ np.array([*sphere.centre, 1.0]))[:3] for sphere in spheres])
    radii = np.array([sphere.radius for sphere in spheres])
    t = float(trace["t"][k])
    arm = scene.find("forearm")
    pose = Pose((arm.pose.position[0], 0.4 - 0.03 * t, arm.pose.position[2]), arm.pose.quaternion)
    objects = tuple(msgspec.structs.replace(arm, pose=pose) if one is arm else one for one in scene.objects)
    gaps = np.linalg.norm(centres - np.array(pose.position), axis=1) - radii - 0.12
    delta = trace["delta"][: k + 1]
    numbers = {
        "phase": trace.phases[int(trace["phase"][k])],
        "status": ("safe", "modified")[int(trace["status"][k])],
        "barriers": "obstacle",
        "h_min": float(trace["h_min"][k]),
        "delta": float(delta[-1]),
        "Delta": float(delta.mean()),
        "intervention_frequency": float((delta > 0).mean()),
        "speed": float(np.linalg.norm(trace["u"][k])),
        "planner": "idle",
        "elapsed": t,
    }
    poses = {name: Pose(tuple(T[:3, 3]), matrix_to_quaternion(T[:3, :3])) for name, T in frames.items()}
    margins = {one.name: one.error + 0.01 for one in objects if one.role != "support"}
    perceived = msgspec.structs.replace(scene, objects=objects)
    lines = ("attempt 1: rejected at envelope", "attempt 2: accepted", "<b>wrist vs 'forearm'</b>: 12 mm, slowed 41 %")
    return ViewState(
        t=t,
        frames=poses,
        scene=perceived,
        centres=centres,
        radii=radii,
        clearances=gaps,
        margins=margins,
        target=(0.45, 0.28, 0.12),
        numbers=numbers,
        lines=lines,
    )
