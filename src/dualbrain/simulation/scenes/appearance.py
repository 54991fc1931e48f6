"""Appearance of a scene: colours, materials, lights, cameras, and the surfaces of bowls and people; no physics.

All geoms added here are in group 2, without collision and without mass.
"""

# MuJoCo ships no type stubs:
# pyright: reportAttributeAccessIssue=false

from __future__ import annotations

import mujoco
import numpy as np

from dualbrain.core.geometry.shapes import Bowl
from dualbrain.simulation.scenes.colours import colour_rgba
from dualbrain.simulation.scenes.scene_spec import TABLE_X, TABLE_Y, MovingPerson

_GEOM = mujoco.mjtGeom
VISUAL_ONLY = {"group": 2, "contype": 0, "conaffinity": 0, "mass": 0.0}


def add_table_appearance(root: mujoco.MjSpec, floor: float) -> None:
    """Add sky, floor and table materials, lights, table legs and the three cameras front, top and side."""
    _add_materials_and_lights(root)
    _add_table_legs(root, floor)
    _add_camera(root, "front", (1.68, -0.84, 1.00), (0.31, 0.0, 0.245), fovy=38)
    _add_camera(root, "top", (0.42, 0.0, 1.85), (0.40, 0.0, 0.0), fovy=40, up=(1.0, 0.0, 0.0))
    _add_camera(root, "side", (0.42, -1.85, 0.62), (0.38, 0.0, 0.25), fovy=40)


def add_room_appearance(root: mujoco.MjSpec) -> None:
    """Add sky, floor and lights of a room and the three cameras front, top and side."""
    _add_materials_and_lights(root)
    _add_camera(root, "front", (-3.2, -4.4, 4.2), (2.0, 0.2, 0.2), fovy=48)
    _add_camera(root, "top", (2.0, 0.0, 8.5), (2.0, 0.0, 0.0), fovy=45, up=(0.0, 1.0, 0.0))
    _add_camera(root, "side", (2.0, -7.0, 3.0), (2.0, 0.0, 0.3), fovy=45)


def _add_materials_and_lights(root: mujoco.MjSpec) -> None:
    """Add sky, floor and table materials and lights."""
    root.visual.global_.offwidth, root.visual.global_.offheight = 1280, 960
    root.visual.headlight.ambient, root.visual.headlight.diffuse = [0.38] * 3, [0.18] * 3
    root.visual.headlight.specular = [0.05] * 3
    root.visual.quality.shadowsize, root.visual.map.znear = 4096, 0.02
    sky = root.add_texture(name="sky", type=mujoco.mjtTexture.mjTEXTURE_SKYBOX, width=256, height=1536)
    sky.builtin, sky.rgb1, sky.rgb2 = mujoco.mjtBuiltin.mjBUILTIN_GRADIENT, [0.90, 0.93, 0.96], [0.66, 0.71, 0.77]
    tiles = root.add_texture(name="tiles", type=mujoco.mjtTexture.mjTEXTURE_2D, width=512, height=512)
    tiles.builtin, tiles.rgb1, tiles.rgb2 = mujoco.mjtBuiltin.mjBUILTIN_CHECKER, [0.70, 0.72, 0.75], [0.64, 0.66, 0.69]
    ground = root.add_material(name="floor", texrepeat=[6, 6], texuniform=False, specular=0.1)
    ground.textures[mujoco.mjtTextureRole.mjTEXROLE_RGB] = "tiles"
    root.add_material(name="table", rgba=[0.83, 0.75, 0.64, 1], specular=0.15, shininess=0.2)
    root.add_material(name="satin", specular=0.35, shininess=0.45)
    root.add_material(name="glass", specular=0.9, shininess=0.9)
    lamp = {"type": mujoco.mjtLightType.mjLIGHT_DIRECTIONAL}
    root.worldbody.add_light(name="sun", pos=[0.2, -1.2, 2.4], dir=[0.15, 0.55, -1.0], diffuse=[0.48] * 3, **lamp)
    root.worldbody.add_light(
        name="fill", pos=[1.5, 1.5, 2.0], dir=[-0.6, -0.6, -0.6], diffuse=[0.18] * 3, castshadow=False, **lamp
    )


def add_bowl_visuals(root: mujoco.MjSpec, body: mujoco.MjsBody, name: str, bowl: Bowl, rgba: tuple[float, ...]) -> None:
    """Add the surface of a bowl, a profile rotated about z, over the collision geoms of its wall."""
    outer, inner, high, base = bowl.radius + 0.002, bowl.radius - bowl.wall - 0.002, bowl.height, 0.75 * bowl.radius
    profile = [(0, 0.0005), (base, 0.0005), (outer - 0.006, 0.010), (outer, 0.024), (outer, high - 0.001)]
    profile += [(outer - 0.002, high + 0.001), (inner, high), (inner, 0.022), (inner - 0.008, 0.011), (0, 0.0085)]
    around, rings = 64, len(profile)
    angle = 2 * np.pi * np.arange(around) / around
    points = [(r * np.cos(a), r * np.sin(a), z) for r, z in profile for a in angle]
    faces = []
    for ring in range(rings - 1):
        for k in range(around):
            a, b = ring * around + k, ring * around + (k + 1) % around
            faces += [(a, b, b + around), (a, b + around, a + around)]
    mesh = root.add_mesh(name=f"{name}_look", inertia=mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL)
    mesh.uservert, mesh.userface = np.array(points).ravel(), np.array(faces).ravel()
    body.add_geom(type=_GEOM.mjGEOM_MESH, meshname=mesh.name, rgba=rgba, material="satin", **VISUAL_ONLY)


def add_forearm_visuals(body: mujoco.MjsBody, mover: MovingPerson) -> None:
    """Add sleeve, wrist, palm and fingers inside the collision capsule of a forearm; the hand is at its inner end."""
    r, inner = mover.radius, -mover.half_length
    axis = np.array(mover.axis) / np.linalg.norm(mover.axis)
    side = np.cross([0.0, 0.0, 1.0], axis)

    def rod(start: float, end: float, radius: float, colour: str, *, shift: float = 0.0, kind: str = "CAPSULE") -> None:
        a, b = axis * start + side * shift, axis * end + side * shift
        shape = getattr(_GEOM, f"mjGEOM_{kind}")
        body.add_geom(type=shape, size=[radius, 0, 0], fromto=[*a, *b], rgba=colour_rgba(colour), **VISUAL_ONLY)

    rod(inner + 0.22, mover.half_length, 0.97 * r, "sleeve")
    rod(inner + 0.175, inner + 0.20, 0.99 * r, "sleeve", kind="CYLINDER")
    rod(inner + 0.06, inner + 0.22, 0.62 * r, "skin")
    palm = body.add_geom(
        type=_GEOM.mjGEOM_ELLIPSOID,
        size=[0.052, 0.036, 0.018],
        pos=axis * (inner + 0.045),
        rgba=colour_rgba("skin"),
        **VISUAL_ONLY,
    )
    palm.quat = _yaw_quaternion(axis)
    for shift in (-0.024, -0.008, 0.008, 0.024):
        rod(inner - 0.028 + 0.4 * abs(shift), inner + 0.03, 0.0078, "skin", shift=shift)
    rod(inner + 0.015, inner + 0.06, 0.0085, "skin", shift=0.034)


def add_person_visuals(body: mujoco.MjsBody, mover: MovingPerson) -> None:
    """Add a head, a trunk and two legs inside the upright collision capsule of a person."""
    r, half = mover.radius, mover.half_length

    def rod(start: float, end: float, radius: float, colour: str, y: float = 0.0) -> None:
        body.add_geom(
            type=_GEOM.mjGEOM_CAPSULE,
            size=[radius, 0, 0],
            fromto=[0, y, start, 0, y, end],
            rgba=colour_rgba(colour),
            **VISUAL_ONLY,
        )

    rod(half, half + 0.05, 0.4 * r, "skin")
    rod(-0.05, half - 0.2, 0.72 * r, "sleeve")
    for side in (-1, 1):
        rod(-half, -0.05, 0.3 * r, "black", y=side * 0.35 * r)


def _yaw_quaternion(axis: np.ndarray) -> list[float]:
    yaw = float(np.arctan2(axis[1], axis[0]))
    return [np.cos(yaw / 2), 0, 0, np.sin(yaw / 2)]


def _add_table_legs(root: mujoco.MjSpec, floor: float) -> None:
    half = (-0.04 - floor) / 2
    for x in (TABLE_X[0] + 0.05, TABLE_X[1] - 0.05):
        for y in (TABLE_Y[0] + 0.05, TABLE_Y[1] - 0.05):
            root.worldbody.add_geom(
                type=_GEOM.mjGEOM_CYLINDER,
                size=[0.022, half, 0],
                pos=[x, y, floor + half],
                rgba=[0.32, 0.33, 0.35, 1],
                **VISUAL_ONLY,
            )


def _add_camera(
    root: mujoco.MjSpec,
    name: str,
    position: tuple[float, float, float],
    target: tuple[float, float, float],
    *,
    fovy: float,
    up: tuple[float, float, float] = (0.0, 0.0, 1.0),
) -> None:
    """Add a camera at `position` [m] that looks at `target` [m], with `up` as its upward direction."""
    back = np.subtract(position, target) / np.linalg.norm(np.subtract(position, target))
    right = np.cross(up, back) / np.linalg.norm(np.cross(up, back))
    above = np.cross(back, right)
    root.worldbody.add_camera(name=name, pos=position, xyaxes=[*right, *above], fovy=fovy)
