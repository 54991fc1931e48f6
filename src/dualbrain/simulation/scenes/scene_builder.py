"""A `SceneSpec` becomes a MuJoCo model: room, table, things, forearm, robot.

Physics settings: 1 ms, implicitfast, elliptic friction cone, impratio 10 (contact-only grasping needs them). They are
set on the root spec because attaching keeps the parent's. Geom groups: 0 room, 1 things, 2 looks only, 3 hidden
collision shapes. Robot names carry the prefix `robot/`.
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
    colour_rgba,
)
from dualbrain.simulation.scenes.moving_person import PERSON_DAMPING, PERSON_STIFFNESS, person_path
from dualbrain.simulation.scenes.scene_spec import TABLE_X, TABLE_Y, MovingPerson, ObjectSpec, SceneSpec

PHYSICS_PERIOD = 1e-3
ROBOT_PREFIX = "robot/"
TABLE_THICKNESS = 0.04
FLOOR_HEIGHT = -0.74
N_BOWL_STAVES = 20
WALL_SIZE = (0.05, 0.5)
"""Half the thickness and the height of a wall [m]."""
SLIPPERY_FRICTION = 0.4
"""Below this coefficient a thing slips on rubber pads, too; else pads decide what friction they have."""
SLIPPERY_CONTACT = {"priority": 2, "solref": [0.005, 1.0], "solimp": [0.95, 0.99, 0.001, 0.5, 2.0]}
"""Its own friction counts, with the pads' own softness."""
LOAD_NAME, LOAD_DENSITY = "load", 3000.0
"""Name and density [kg/m³] of a cube that is fixed at the tool."""

_GEOM = mujoco.mjtGeom


def build_model(spec: SceneSpec, robot: MujocoModel, *, load: float = 0.0) -> mujoco.MjModel:
    """Compile the scene with the robot at the origin. The robot's spec is consumed: hand in a fresh one.

    `load` [kg] is welded to the site `tcp`: a body of its own, so that it is in no inertia of the arm's.
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
    for thing in spec.objects:
        add_object(root, thing)
    if spec.mover is not None:
        add_moving_person(root, spec.mover)
    frame = root.worldbody.add_frame()
    standing = frame.attach_body(robot.root, ROBOT_PREFIX, "")
    if robot.mounted_arm is not None:
        mount = standing.add_frame(pos=list(robot.mount_position))
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
    root.option.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_AUTORESET)  # a blown-up state must be seen, not hidden


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
    """A floor, and a wall along every edge of the region, outside of it."""
    _add_floor(root, 0.0)
    thick, high = WALL_SIZE
    for index, (x, y) in enumerate(corners):
        along = np.subtract(corners[(index + 1) % len(corners)], (x, y))
        length = float(np.linalg.norm(along))
        out = np.array([along[1], -along[0]]) / length
        yaw = float(np.arctan2(along[1], along[0]))
        middle = np.array([x, y]) + along / 2 + thick * out
        root.worldbody.add_geom(
            name=f"wall_{index}",
            type=_GEOM.mjGEOM_BOX,
            size=[length / 2 + 2 * thick, thick, high / 2],
            pos=[*middle, high / 2],
            quat=[np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)],
            rgba=[0.85, 0.85, 0.83, 0.35],
        )


def add_object(root: mujoco.MjSpec, thing: ObjectSpec) -> None:
    """A body called `thing.name`; free unless fixed."""
    body = root.worldbody.add_body(name=thing.name, pos=list(thing.position), quat=list(thing.quaternion))
    if not thing.fixed:
        body.add_freejoint(name=thing.name)
    if isinstance(thing.shape, Bowl):
        _add_bowl(root, body, thing, thing.shape)
        return
    kind, size = geom_type_and_size(thing)
    body.add_geom(
        name=thing.name,
        type=kind,
        size=size,
        mass=thing.mass,
        rgba=colour_rgba(thing.colour),
        group=1,
        friction=[thing.friction, 0.02, 0.001],
        condim=4 if isinstance(thing.shape, Box) else 6,
        material="glass" if thing.colour == "clear" else "satin",
        **(SLIPPERY_CONTACT if thing.friction < SLIPPERY_FRICTION else {}),
    )


def geom_type_and_size(thing: ObjectSpec) -> tuple[mujoco.mjtGeom, list[float]]:
    """MuJoCo's geom type and size of a solid shape."""
    match thing.shape:
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


def _add_bowl(root: mujoco.MjSpec, body: mujoco.MjsBody, thing: ObjectSpec, bowl: Bowl) -> None:
    """A disc and a ring of staves: hollow, so that it holds things by contact."""
    share = {"rgba": colour_rgba(thing.colour), "friction": [thing.friction, 0.02, 0.001], "condim": 4, "group": 3}
    floor, wall = 0.004, bowl.wall / 2
    body.add_geom(
        name=f"{thing.name}_bottom",
        type=_GEOM.mjGEOM_CYLINDER,
        size=[bowl.radius - bowl.wall, floor, 0],
        pos=[0, 0, floor],
        mass=0.6 * thing.mass,
        **share,
    )
    radius, half = bowl.radius - wall, (bowl.height - 2 * floor) / 2
    chord = bowl.radius * float(np.tan(np.pi / N_BOWL_STAVES))
    for index in range(N_BOWL_STAVES):
        angle = 2 * np.pi * index / N_BOWL_STAVES
        body.add_geom(
            name=f"{thing.name}_{index}",
            type=_GEOM.mjGEOM_BOX,
            size=[wall, chord, half],
            pos=[radius * np.cos(angle), radius * np.sin(angle), 2 * floor + half],
            quat=[np.cos(angle / 2), 0, 0, np.sin(angle / 2)],
            mass=0.4 * thing.mass / N_BOWL_STAVES,
            **share,
        )
    add_bowl_visuals(root, body, thing.name, bowl, colour_rgba(thing.colour))


def add_moving_person(root: mujoco.MjSpec, mover: MovingPerson) -> None:
    """The forearm: three slides, no gravity, each axis driven with at most force/√3."""
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
