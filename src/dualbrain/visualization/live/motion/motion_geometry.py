"""Geometry of the filter's work at one tick: tool velocities, motion without the filter, nearest pair, planned path."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.contract import Action
from dualbrain.core.geometry.distance import bounding_solid, signed_distance
from dualbrain.core.geometry.rotations import matrix_to_quaternion
from dualbrain.core.geometry.shapes import Pose, Vector
from dualbrain.records import Scene, SceneObject
from dualbrain.robots.collision_model.self_collision import chain_frames, unit_quaternion_to_matrix
from dualbrain.robots.model import RobotModel
from dualbrain.visualization.live.view_state import PlanStep

Array = NDArray[np.float64]

GHOST_HORIZON_S = 0.5
"""Time [s] over which the nominal control is integrated for the translucent arm."""
PAIR_TOLERANCE_M = 0.004
"""Largest difference [m] between the drawn pair's clearance and the filter's h_min."""
GRADIENT_STEP_M = 1e-4
TARGET_PARAMETERS = ("object", "destination", "target", "place", "onto", "position")
"""Parameters of skills that name the place of a step, in the order in which they are looked up."""
SKILL_WORDS = {"place": "place at"}
"""Words for skills whose name before the name of an object would mean something else."""


def unfiltered_configuration(robot_model: RobotModel, q: Array, u_nom: Array) -> Array:
    """Joint positions (n,) [rad] after `GHOST_HORIZON_S` of the nominal control from `q`, within the joint limits."""
    low = np.array([joint.lower.value for joint in robot_model.joints])
    high = np.array([joint.upper.value for joint in robot_model.joints])
    return np.clip(q + GHOST_HORIZON_S * u_nom, low, high)


def link_poses(robot_model: RobotModel, q: Array, opening: float | None) -> dict[str, Pose]:
    """Pose of every link of an arm on a fixed base at `q` (n,) [rad], with `opening` [m] per finger (None: closed)."""
    turns, origins = chain_frames(robot_model.joints, q[None])
    poses: dict[str, Pose] = {}
    for link in robot_model.links:
        turn, origin = turns[0, link.frame], origins[0, link.frame]
        local = np.array(link.translation) + unit_quaternion_to_matrix(link.quaternion) @ (
            (opening or 0.0) * np.array(link.slide)
        )
        x, y, z = origin + turn @ local
        rotation = turn @ unit_quaternion_to_matrix(link.quaternion)
        poses[link.name] = Pose((float(x), float(y), float(z)), matrix_to_quaternion(rotation))
    return poses


def nearest_pair(
    scene: Scene, margins: Mapping[str, float], centres: Array, radii: Array, h_min: float
) -> tuple[Vector, Vector] | None:
    """End points [m], on the robot and on the object, of the pair whose clearance is the filter's `h_min` [m].

    `centres` (k, 3) and `radii` (k,) [m] are the spheres of the moving links. The clearance of a pair is its distance
    without the margin of the object. None if no pair of sphere and object has this clearance within
    `PAIR_TOLERANCE_M`: then two links, or a limit, are the nearest.
    """
    best: tuple[float, int, SceneObject] | None = None
    for one in scene.objects if np.isfinite(h_min) and len(radii) else ():
        solid, pose = bounding_solid(one.shape, one.pose)
        gaps = signed_distance(solid, pose, centres) - radii - margins.get(one.name, 0.0)
        errors = np.abs(gaps - h_min)
        k = int(np.argmin(errors))
        if errors[k] <= PAIR_TOLERANCE_M and (best is None or errors[k] < best[0]):
            best = (float(errors[k]), k, one)
    if best is None:
        return None
    _, k, one = best
    return _end_points(one, centres[k], float(radii[k]))


def plan_steps(actions: Sequence[Action], scene: Scene, tool_home: Vector) -> tuple[PlanStep, ...]:
    """The steps of a contract with the place of each one: of the object or place that it names, else `tool_home`."""
    places = {one.name: one.pose.position for one in scene.objects} | {one.name: one.position for one in scene.places}
    steps: list[PlanStep] = []
    for action in actions:
        names = [str(action.params[key]) for key in TARGET_PARAMETERS if key in action.params]
        known = next((name for name in names if name in places), "")
        x, y, z = places[known] if known else tool_home
        words = (SKILL_WORDS.get(action.skill, action.skill), known or (names[0] if names else ""))
        label = " ".join(words).strip().replace("_", " ")
        steps.append(PlanStep(label=label, position=(x, y, z)))
    return tuple(steps)


def _end_points(one: SceneObject, centre: Array, radius: float) -> tuple[Vector, Vector]:
    """The nearest points of a sphere and of an object, along the gradient of the signed distance."""
    solid, pose = bounding_solid(one.shape, one.pose)
    probes = np.concatenate([centre[None], centre + GRADIENT_STEP_M * np.eye(3)])
    distance, *along = signed_distance(solid, pose, probes).tolist()
    gradient = (np.array(along) - distance) / GRADIENT_STEP_M
    gradient /= max(float(np.linalg.norm(gradient)), 1e-9)
    return _vector(centre - radius * gradient), _vector(centre - distance * gradient)


def _vector(values: Array) -> Vector:
    x, y, z = values.tolist()
    return (x, y, z)
