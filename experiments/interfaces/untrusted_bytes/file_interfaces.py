"""Files that describe a robot, a site, a scene, a map or a suite."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from importlib.resources import files
from pathlib import Path
from typing import Any
from unittest.mock import patch

import msgspec
import numpy as np

from dualbrain.core.untrusted.toml_document import TomlFault, parse_toml
from dualbrain.evaluation.protocol.suite import parse_suite
from dualbrain.robots.importer import kinematic_tree
from dualbrain.robots.importer.kinematic_tree import KinematicTree
from dualbrain.robots.importer.urdf import read_urdf
from dualbrain.robots.loader import data_file, read_robot
from dualbrain.robots.site_config import read_site
from dualbrain.simulation.models.mjcf_reader import read_mjcf
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from dualbrain.simulation.scenes.scene_spec import load_scene
from experiments.interfaces.untrusted_bytes.interface import (
    ALWAYS_REFUSED,
    ByteInterface,
    Surprise,
    refuse_if,
    require_usable,
)
from experiments.interfaces.untrusted_bytes.mutation import JSON, TOML, XML, Syntax, mutate_text
from experiments.interfaces.untrusted_bytes.text_interfaces import run_in_process

SITE = b"""
[robot]
period = 0.005
tool_speed = 0.5
[limits]
velocity = 1.0
acceleration = 5.0
[joint.panda_joint1]
velocity = 0.8
lower = -1.5
upper = 1.5
[tool]
position = [0.0, 0.0, 0.05]
quaternion = [1.0, 0.0, 0.0, 0.0]
spheres = [{centre = [0.0, 0.0, 0.1], radius = 0.02}]
[payload]
spheres = [{centre = [0.0, 0.0, 0.15], radius = 0.03}]
error = 0.002
[[plane]]
name = "wall"
point = [-0.5, 0.0, 0.0]
inward = [1.0, 0.0, 0.0]
margin = 0.02
[[keep_out]]
name = "shelf"
position = [0.5, 0.5, 0.3]
half_extents = [0.1, 0.1, 0.3]
yaw = 0.2
[commander.planner]
skills = ["grasp", "release"]
"""
URDF = b"""<?xml version='1.0'?>
<robot name='a'><link name='l0'/><link name='l1'><collision><origin xyz='0 0 0.1' rpy='0 0.1 0'/>
<geometry><box size='0.1 0.1 0.2'/></geometry></collision></link>
<joint name='j' type='revolute'><origin xyz='0 0 0.3' rpy='0 0 0'/><parent link='l0'/><child link='l1'/>
<axis xyz='0 0 1'/><limit lower='-1' upper='1' velocity='1' effort='10'/></joint></robot>
"""
MJCF = b"""<mujoco model='a'><compiler angle='radian'/><worldbody><body name='b0'><geom type='sphere' size='0.1'/>
<body name='b1' pos='0 0 0.3'><joint name='j' axis='0 0 1' range='-1 1'/><geom type='capsule' size='0.05 0.1'/>
</body></body></worldbody></mujoco>
"""
STRUCTURED = ALWAYS_REFUSED
DESCRIPTION_SHARE, COMPILER_SHARE = 0.1, 0.002


def file_interfaces(folder: Path) -> dict[str, ByteInterface]:
    """Interfaces by name; their files are written to `folder`."""

    def through_file(name: str, read: Callable[[Path], Any]) -> Callable[[bytes], None]:
        path = folder / name

        def read_bytes(data: bytes) -> None:
            path.write_bytes(data)
            require_usable(read(path))

        return read_bytes

    def urdf(path: Path) -> dict[str, Any]:
        with patch.object(kinematic_tree, "run_bounded", run_in_process):
            return _usable_tree(read_urdf(path))

    def toml(data: bytes) -> None:
        found = parse_toml(data)
        refuse_if(isinstance(found, TomlFault), found)

    def suite(data: bytes) -> None:
        require_usable(parse_suite(data, "tiny"))

    robot = data_file("panda").read_bytes()
    scene = msgspec.json.encode(open_scene("tabletop:1"))
    interfaces = {
        "site file": (SITE, TOML, through_file("site.toml", lambda path: read_site(path).site), 0.3),
        "suite": (files("dualbrain.evaluation").joinpath("suites/smoke.toml").read_bytes(), TOML, suite, 0.3),
        "TOML": (SITE, TOML, toml, 0.3),
        "robot file": (robot, JSON, through_file("robot.json", read_robot), 0.1),
        "scene file": (scene, JSON, through_file("scene.json", load_scene), 1.0),
        "URDF": (URDF, XML, through_file("robot.urdf", urdf), DESCRIPTION_SHARE),
        "MJCF": (MJCF, XML, through_file("robot.xml", lambda path: _usable_tree(read_mjcf(path))), COMPILER_SHARE),
    }
    refuses = {"TOML": frozenset({"deep", "compressed"}), "URDF": STRUCTURED | {"truncated"}, "MJCF": STRUCTURED}
    refuses["site file"] = STRUCTURED - {"no bytes"}  # a site without entries is a site
    return {
        name: ByteInterface(
            mutate=_mutator(data, syntax), read=read, refuses=refuses.get(name, STRUCTURED), share=share
        )
        for name, (data, syntax, read, share) in interfaces.items()
    }


def _mutator(data: bytes, syntax: Syntax) -> Callable[..., bytes | None]:
    return lambda kind, rng: partial(mutate_text, data=data, syntax=syntax)(kind, rng=rng)


def _usable_tree(tree: KinematicTree) -> dict[str, Any]:
    """Poses, axes and limits of a tree; raises `Surprise` for one that is not finite."""
    found = {
        joint.name: [np.asarray(value, float).tolist() for value in (joint.pose, joint.axis)] for joint in tree.joints
    }
    for values in found.values():
        if not all(np.isfinite(value).all() for value in values):
            raise Surprise(f"accepted the pose or axis {values}")
    return found
