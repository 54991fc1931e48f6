"""Builds the MuJoCo model of a `SceneSpec`: room, table, objects, moving person, robot.

Physics settings: 1 ms, implicitfast, elliptic friction cone, impratio 10 (grasping by contact alone needs them). They
are set on the root spec, because attaching keeps the parent's settings. Geom groups: 0 room, 1 objects, 2 visual only,
3 hidden collision shapes. Names of robot elements have the prefix `robot/`.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np

from dualbrain.core.geometry.shapes import Bowl, Box, Capsule, Cylinder, Sphere
from dualbrain.simulation.models.mujoco_model import MujocoModel
from dualbrain.simulation.scenes.appearance import (
    add_bowl_visuals,
    add_forearm_visuals,
    add_person_visuals,
    add_room_appearance,
    add_table_appearance,
)
from dualbrain.simulation.scenes.colours import colour_rgba
from dualbrain.simulation.scenes.moving_person import PERSON_DAMPING, PERSON_STIFFNESS, person_path
from dualbrain.simulation.scenes.scene_spec import TABLE_X, TABLE_Y, MovingPerson, ObjectSpec, SceneSpec

PHYSICS_PERIOD = 1e-3
ROBOT_PREFIX = "robot/"
TABLE_THICKNESS = 0.04
FLOOR_HEIGHT = -0.74
N_BOWL_STAVES = 20
WALL_SIZE = (0.05, 0.5)
"""Half thickness and height of a wall [m]."""
SLIPPERY_FRICTION = 0.4
"""Below this coefficient an object also slips on rubber pads; otherwise the pads determine the friction of a grip."""
SLIPPERY_CONTACT = {"priority": 2, "solref": [0.005, 1.0], "solimp": [0.95, 0.99, 0.001, 0.5, 2.0]}
"""Contact parameters of a slippery object: its own friction coefficient with the softness of the pads."""
LOAD_NAME, LOAD_DENSITY = "load", 3000.0
"""Name and density [kg/m³] of the cube that represents a load at the tool."""

_GEOM = mujoco.mjtGeom


def build_model(spec: SceneSpec, robot: MujocoModel, *, load: float = 0.0) -> mujoco.MjModel:
    """Compile the scene with the robot at the origin. The spec of `robot` is consumed: pass a new `MujocoModel`.

    `load` [kg] is a separate body welded to the site `tcp`, so that it does not change the inertia of the arm.
    """
    root = mujoco.MjSpec()
    root.modelname = f"{spec.family}_{spec.seed}"
    _set_options(root)
    if spec.region:
        add_room_appearance(root)
        _add_walls(root, spec.region)
    else:
        add_table_appearance(root, FLOOR_HEIGHT)
        _add_table(root)
    for obj in spec.objects:
        add_object(root, obj)
    if spec.mover is not None:
        add_moving_person(root, spec.mover)
    frame = root.worldbody.add_frame()
    root_body = frame.attach_body(robot.root, ROBOT_PREFIX, "")
    if robot.mounted_arm is not None:
        mount = root_body.add_frame(pos=list(robot.mount_position))
        mount.attach_body(robot.mounted_arm.root, ROBOT_PREFIX, "")
    if load > 0.0:
        _add_load(root, load)
    return root.compile()


def _add_load(root: mujoco.MjSpec, mass: float) -> None:
    body = root.worldbody.add_body(name=LOAD_NAME)
    body.add_freejoint(name=LOAD_NAME)
    half = 0.5 * (mass / LOAD_DENSITY) ** (1.0 / 3.0)
    body.add_geom(
        name=LOAD_NAME,
        type=_GEOM.mjGEOM_BOX,
        size=[half] * 3,
        mass=mass,
        group=3,
        contype=0,
        conaffinity=0,
        rgba=colour_rgba("grey"),
    )
    body.add_site(name=LOAD_NAME)
    root.add_equality(
        name=LOAD_NAME,
        type=mujoco.mjtEq.mjEQ_WELD,
        objtype=mujoco.mjtObj.mjOBJ_SITE,
        name1=f"{ROBOT_PREFIX}tcp",
        name2=LOAD_NAME,
        solref=[2.0 * PHYSICS_PERIOD, 1.0],
        solimp=[0.99, 0.999, 1e-3, 0.5, 2.0],
    )


def _set_options(root: mujoco.MjSpec) -> None:
    root.option.timestep = PHYSICS_PERIOD
    root.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    root.option.cone = mujoco.mjtCone.mjCONE_ELLIPTIC
    root.option.impratio = 10.0
    root.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # diverging states stay visible


def _add_table(root: mujoco.MjSpec) -> None:
    table = root.worldbody.add_body(name="table")
    half = [(TABLE_X[1] - TABLE_X[0]) / 2, (TABLE_Y[1] - TABLE_Y[0]) / 2, TABLE_THICKNESS / 2]
    centre = [(TABLE_X[0] + TABLE_X[1]) / 2, (TABLE_Y[0] + TABLE_Y[1]) / 2, -TABLE_THICKNESS / 2]
    table.add_geom(
        name="table", type=_GEOM.mjGEOM_BOX, size=half, pos=centre, material="table", friction=[0.8, 0.005, 0.0001]
    )
    _add_floor(root, FLOOR_HEIGHT)


def _add_floor(root: mujoco.MjSpec, height: float) -> None:
    floor = root.worldbody.add_geom(name="floor", type=_GEOM.mjGEOM_PLANE, size=[8, 8, 0.05], pos=[0, 0, height])
    floor.material = "floor"


def _add_walls(root: mujoco.MjSpec, corners: Sequence[tuple[float, float]]) -> None:
    """Add a floor, and a wall outside every edge of the region with `corners` (x, y) [m]."""
    _add_floor(root, 0.0)
    half_thickness, height = WALL_SIZE
    for index, (x, y) in enumerate(corners):
        along = np.subtract(corners[(index + 1) % len(corners)], (x, y))
        length = float(np.linalg.norm(along))
        out = np.array([along[1], -along[0]]) / length
        yaw = float(np.arctan2(along[1], along[0]))
        middle = np.array([x, y]) + along / 2 + half_thickness * out
        root.worldbody.add_geom(
            name=f"wall_{index}",
            type=_GEOM.mjGEOM_BOX,
            size=[length / 2 + 2 * half_thickness, half_thickness, height / 2],
            pos=[*middle, height / 2],
            quat=[np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)],
            rgba=[0.85, 0.85, 0.83, 0.35],
        )


def add_object(root: mujoco.MjSpec, obj: ObjectSpec) -> None:
    """Add the body of an object, called `obj.name`; free unless `obj.fixed`."""
    body = root.worldbody.add_body(name=obj.name, pos=list(obj.position), quat=list(obj.quaternion))
    if not obj.fixed:
        body.add_freejoint(name=obj.name)
    if isinstance(obj.shape, Bowl):
        _add_bowl(root, body, obj, obj.shape)
        return
    kind, size = geom_type_and_size(obj)
    body.add_geom(
        name=obj.name,
        type=kind,
        size=size,
        mass=obj.mass,
        rgba=colour_rgba(obj.colour),
        group=1,
        friction=[obj.friction, 0.02, 0.001],
        condim=4 if isinstance(obj.shape, Box) else 6,
        material="glass" if obj.colour == "clear" else "satin",
        **(SLIPPERY_CONTACT if obj.friction < SLIPPERY_FRICTION else {}),
    )


def geom_type_and_size(obj: ObjectSpec) -> tuple[mujoco.mjtGeom, list[float]]:
    """MuJoCo geom type and size of a solid shape; raises `TypeError` for another shape."""
    match obj.shape:
        case Box(half_extents=half):
            return _GEOM.mjGEOM_BOX, list(half)
        case Cylinder(radius=radius, half_height=half):
            return _GEOM.mjGEOM_CYLINDER, [radius, half, 0.0]
        case Capsule(radius=radius, half_length=half):
            return _GEOM.mjGEOM_CAPSULE, [radius, half, 0.0]
        case Sphere(radius=radius):
            return _GEOM.mjGEOM_SPHERE, [radius, 0.0, 0.0]
        case other:
            raise TypeError(f"{type(other).__name__} is not a solid shape")


def _add_bowl(root: mujoco.MjSpec, body: mujoco.MjsBody, obj: ObjectSpec, bowl: Bowl) -> None:
    """Add a disc and a ring of staves: a hollow bowl, which holds objects by contact."""
    share = {"rgba": colour_rgba(obj.colour), "friction": [obj.friction, 0.02, 0.001], "condim": 4, "group": 3}
    floor, wall = 0.004, bowl.wall / 2
    body.add_geom(
        name=f"{obj.name}_bottom",
        type=_GEOM.mjGEOM_CYLINDER,
        size=[bowl.radius - bowl.wall, floor, 0],
        pos=[0, 0, floor],
        mass=0.6 * obj.mass,
        **share,
    )
    radius, half = bowl.radius - wall, (bowl.height - 2 * floor) / 2
    chord = bowl.radius * float(np.tan(np.pi / N_BOWL_STAVES))
    for index in range(N_BOWL_STAVES):
        angle = 2 * np.pi * index / N_BOWL_STAVES
        body.add_geom(
            name=f"{obj.name}_{index}",
            type=_GEOM.mjGEOM_BOX,
            size=[wall, chord, half],
            pos=[radius * np.cos(angle), radius * np.sin(angle), 2 * floor + half],
            quat=[np.cos(angle / 2), 0, 0, np.sin(angle / 2)],
            mass=0.4 * obj.mass / N_BOWL_STAVES,
            **share,
        )
    add_bowl_visuals(root, body, obj.name, bowl, colour_rgba(obj.colour))


def add_moving_person(root: mujoco.MjSpec, mover: MovingPerson) -> None:
    """Add the moving person: three slides without gravity, each actuated with at most force/√3."""
    path = person_path(mover)
    distance, _ = path.state_at(0.0)
    body = root.worldbody.add_body(name=mover.name, pos=list(path.start + distance * path.direction), gravcomp=1)
    for index, axis in enumerate(np.eye(3)):
        joint = body.add_joint(name=f"{mover.name}_{'xyz'[index]}", type=mujoco.mjtJoint.mjJNT_SLIDE, axis=axis)
        bound = mover.force / np.sqrt(3.0)
        drive = root.add_actuator(
            name=joint.name, target=joint.name, trntype=mujoco.mjtTrn.mjTRN_JOINT, forcerange=[-bound, bound], group=3
        )
        drive.set_to_position(kp=PERSON_STIFFNESS, kv=PERSON_DAMPING)
    reach = mover.half_length * np.array(mover.axis) / np.linalg.norm(mover.axis)
    body.add_geom(
        name=mover.name,
        type=_GEOM.mjGEOM_CAPSULE,
        size=[mover.radius, 0, 0],
        fromto=[*-reach, *reach],
        mass=mover.mass,
        rgba=colour_rgba("skin"),
        group=3,
        friction=[0.6, 0.005, 0.0001],
    )
    (add_person_visuals if abs(mover.axis[2]) > 0.9 else add_forearm_visuals)(body, mover)
