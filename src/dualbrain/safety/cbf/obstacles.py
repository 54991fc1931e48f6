"""Obstacles of the safety filter, and their construction from perceived scene objects."""

from __future__ import annotations

from collections.abc import Collection

import msgspec

from dualbrain.core.geometry.distance import Solid, bounding_solid
from dualbrain.core.geometry.shapes import IDENTITY_POSE, Pose, Vector
from dualbrain.records import ZERO_VECTOR, Scene, SceneObject
from dualbrain.safety.cbf.rows import Rank


class SpeedAndSeparation(msgspec.Struct, frozen=True):
    """Speed and separation monitoring toward one person, by the formula of ISO/TS 15066 (not a certified function).

    d = v_h (T_r + T_s) + v T_r + v²/(2a), T_s = v/a, gives the speed v toward the person at distance d; the row is
    n'J u ≥ −v. `reaction` T_r [s] is the time until braking begins, `brake` a [m/s²] the deceleration along the row
    that the robot always has, `approach` v_h [m/s] the least assumed speed of the person (ISO 13855: 1.6).
    """

    reaction: float = 0.1
    brake: float = 2.0
    approach: float = 0.0


class PlacedShape(msgspec.Struct, frozen=True):
    """A named `shape` at `pose`."""

    name: str
    shape: Solid
    pose: Pose = IDENTITY_POSE


class Obstacle(PlacedShape, frozen=True, kw_only=True):
    """An obstacle: `shape` at `pose`, moving at `velocity` [m/s].

    - `margin` [m] inflates the shape (position error). `velocity_error` [m/s] bounds the error of the velocity and
      increases the margin with the age of the observation.
    - `known`: the projection φ respects the obstacle. `static`: its observation does not become stale.
    - `rank` is the order of relaxation, `alpha` [1/s] replaces the gain of the filter.
    - `parts`: robot parts that keep away (groups, links, "held"); empty means all.
    - `separation` adds a speed limit by distance. `barrier` is the name of the barrier that the rows belong to.
    """

    velocity: Vector = ZERO_VECTOR
    margin: float = 0.0
    velocity_error: float = 0.0
    known: bool = False
    static: bool = True
    rank: Rank = Rank.OBSTACLE
    alpha: float | None = None
    parts: tuple[str, ...] = ()
    separation: SpeedAndSeparation | None = None
    barrier: str = "obstacle"


def obstacles_from_scene(
    scene: Scene, *, known: Collection[str], held: str | None, clearance: float = 0.0
) -> tuple[Obstacle, ...]:
    """Obstacles for all scene objects except `held`, with the perception error plus `clearance` [m] as margin.

    Objects observed before the stamp of the scene are moved along their velocity, and their margin grows accordingly.
    `known` lists the objects that the projection φ respects.
    """
    return tuple(
        _to_obstacle(obj, scene.stamp, obj.name in known, clearance) for obj in scene.objects if obj.name != held
    )


def _to_obstacle(obj: SceneObject, stamp: float, known: bool, clearance: float) -> Obstacle:
    age = max(0.0, stamp - obj.stamp)
    shape, pose = bounding_solid(obj.shape, obj.pose)
    x, y, z = (p + v * age for p, v in zip(pose.position, obj.velocity, strict=True))
    moves = obj.role == "person" or obj.velocity != ZERO_VECTOR or obj.velocity_error > 0.0
    return Obstacle(
        name=obj.name,
        shape=shape,
        pose=Pose((x, y, z), pose.quaternion),
        velocity=obj.velocity,
        margin=obj.error + obj.velocity_error * age + clearance,
        velocity_error=obj.velocity_error,
        known=known,
        static=not moves,
        rank=Rank.BODY if obj.role == "person" else Rank.OBSTACLE,
    )


class Contact(msgspec.Struct, frozen=True):
    """Permit for `robot_part` (a sphere group or link: "hand", "fingers", "held", "left_finger") to touch `obstacle`.

    The rows of these pairs become n'(J u − v_o) ≥ −max(`speed`, α h): at most `speed` [m/s] at contact, and before it
    at most the speed that the barrier would allow.
    """

    robot_part: str
    obstacle: str
    speed: float
