"""A table with a bowl and six objects, before and after an episode, for tests of the senses."""

from dataclasses import replace as replace_fields

import msgspec
import numpy as np

from dualbrain.core.geometry.shapes import Bowl, Box, Cylinder, Pose
from dualbrain.grounding.outcome.evidence import Evidence
from dualbrain.records import GripProfile, Place, Scene, SceneObject
from tests.grounding.perceived_scenes import TABLE

ERROR = 0.009
"""Bound of the position error of the simulated perception [m]."""
HOME = np.array([0.0, -0.3, 0.0, -2.2, 0.0, 2.0, 0.8])
ELSEWHERE = HOME + 0.4
LYING = (2**-0.5, 2**-0.5, 0.0, 0.0)
SPOTS = {
    "in the bowl": (0.50, 0.25, 0.030),
    "on the rim": (0.58, 0.25, 0.075),
    "above the bowl": (0.50, 0.25, 0.200),
    "left of the bowl": (0.50, 0.40, 0.025),
    "right of the bowl": (0.50, 0.10, 0.025),
    "in front of the bowl": (0.66, 0.25, 0.025),
    "table_left": (0.36, 0.46, 0.025),
    "table_right": (0.36, -0.46, 0.025),
    "3 cm ahead": (0.53, -0.20, 0.025),
    "on the yellow block": (0.60, -0.12, 0.065),
    "pushed to the bowl": (0.50, -0.12, 0.025),
    "pushed away": (0.60, -0.24, 0.025),
    "on the floor": (0.60, -0.76, -0.695),
    "sunk": (0.60, -0.24, -0.005),
    "lifted": (0.50, -0.20, 0.150),
    "far away": (0.30, -0.55, 0.025),
}


def thing(name, x, y, shape, height, *, role="object", limit=None, quaternion=(1.0, 0.0, 0.0, 0.0)):
    colour, category = name.split("_")
    return SceneObject(
        name=name,
        role=role,
        shape=shape,
        pose=Pose((x, y, height), quaternion),
        error=ERROR,
        colour=colour,
        category=category,
        fragile_limit=limit,
    )


BEFORE = Scene(
    robot="panda",
    stamp=0.0,
    version=1,
    objects=(
        TABLE,
        thing("blue_bowl", 0.50, 0.25, Bowl(0.085, 0.055, 0.004), 0.0, role="container"),
        thing("red_cube", 0.50, -0.20, Box((0.02, 0.02, 0.025)), 0.025),
        thing("red_block", 0.38, -0.22, Box((0.02, 0.02, 0.02)), 0.020),
        thing("yellow_block", 0.60, -0.12, Box((0.03, 0.03, 0.02)), 0.020),
        thing("green_tin", 0.62, -0.35, Cylinder(0.02, 0.022), 0.022),
        thing("clear_glass", 0.42, -0.06, Cylinder(0.024, 0.045), 0.045, limit=20.0),
    ),
    places=(
        Place("table_left", (0.36, 0.46, 0.0)),
        Place("table_right", (0.36, -0.46, 0.0)),
        Place("table_front", (0.68, 0.03, 0.0)),
    ),
)


def scene_after(moves, *, fallen=(), gone=(), noise=None):
    """`BEFORE` with the objects in `moves` at their spots; `noise` (name → offset (3,) [m]) shifts the perception."""
    objects = []
    for obj in BEFORE.objects:
        if obj.name in gone:
            continue
        position = spot(moves[obj.name], obj) if obj.name in moves else obj.pose.position
        if noise is not None and obj.role != "support":
            position = tuple((np.array(position) + noise[obj.name]).tolist())
        quaternion = LYING if obj.name in fallen else obj.pose.quaternion
        objects.append(msgspec.structs.replace(obj, pose=Pose(position, quaternion)))
    return msgspec.structs.replace(BEFORE, stamp=20.0, objects=tuple(objects))


def spot(where, obj):
    """Position of `obj` at a named spot: tall objects have their centre higher."""
    x, y, z = SPOTS[where]
    return (x, y, z + (obj.pose.position[2] - 0.025 if obj.name != "red_cube" and z < 0.06 else 0.0))


def grip(name, force=20.0, **fields):
    values = {
        "object_name": name,
        "max_force": force,
        "first_opening": 0.020,
        "min_opening": 0.0199,
        "fastest_closing": 1e-5,
        "released": True,
        "end_force": 0.0,
        "end_opening": 0.04,
        "holds_at_end": False,
    }
    return GripProfile(**(values | fields))


def holding(name, force=20.0):
    return grip(name, force, released=False, end_force=force, end_opening=0.02, holds_at_end=True)


def evidence(moves=(), *, hand="", robot=ELSEWHERE, before=BEFORE, declined=False, grips=None, **scene):
    """Evidence of an episode after which the objects in `moves` are elsewhere, `hand` in the gripper."""
    moves = dict(moves)
    if hand:
        moves.setdefault(hand, "lifted")
    handled = [holding(name) if name == hand else grip(name) for name in moves]
    return Evidence(
        before=before,
        after=scene_after(moves, **scene),
        q_before=HOME,
        q_after=HOME if declined else robot,
        home=HOME,
        declined=declined,
        placements={},
        grips=tuple(handled if grips is None else grips),
        in_hand=hand,
    )


def with_placements(one, **placements):
    """`one` for a contract that states the destinations `placements`."""
    return replace_fields(one, placements=placements)
