"""Small descriptions for tests, written out so that each test sees what it is about."""

import textwrap
from pathlib import Path

import numpy as np

from dualbrain.robots.importer.required_limits import Given, Policy

SAID = "test"


def policy(acceleration=10.0, **more):
    every = {"acceleration": Given(acceleration, SAID)} | {side: Given(value, SAID) for side, value in more.items()}
    return Policy(every, {}, {"period": Given(0.002, SAID), "tool_speed": Given(0.25, SAID)})


def link(name, size=(0.05, 0.05, 0.2), at=(0, 0, 0.1)):
    shape = f'<geometry><box size="{size[0]} {size[1]} {size[2]}"/></geometry>'
    place = f'<origin xyz="{at[0]} {at[1]} {at[2]}"/>'
    return f'<link name="{name}"><collision>{place}{shape}</collision></link>'


def joint(name, parent, child, kind="revolute", axis="0 1 0", xyz="0 0 0.2", rpy="0 0 0", inside=None):
    limit = '<limit lower="-2" upper="2" velocity="1.5" effort="9"/>' if inside is None else inside
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{limit}</joint>'
    )


def urdf(*parts, name="Test Arm-7"):
    return f'<?xml version="1.0"?>\n<robot name="{name}">\n' + "\n".join(parts) + "\n</robot>\n"


def written(folder, text, name="robot.urdf"):
    path = Path(folder) / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(textwrap.dedent(text))
    return path


def arm_with_everything():
    """Slide, turn, endless turn on crooked axes, a fixed flange, a hand with two fingers, one of which follows."""
    finger = '<limit lower="0" upper="0.04" velocity="0.1" effort="9"/>'
    return urdf(
        link("base"), link("column"), link("upper"), link("lower"), link("flange", (0.04, 0.04, 0.02), (0, 0, 0.01)),
        link("palm", (0.1, 0.04, 0.04), (0, 0, 0.03)), link("left", (0.01, 0.02, 0.05), (0, 0, 0.025)),
        link("right", (0.01, 0.02, 0.05), (0, 0, 0.025)),
        joint("lift", "base", "column", "prismatic", "0 0 1", "0.1 0 0.3",
              inside='<limit lower="0" upper="0.5" velocity="0.2" effort="9"/>'),
        joint("shoulder", "column", "upper", axis="1 2 -0.5", xyz="0.1 0.05 0.2", rpy="0.3 -0.2 0.7"),
        joint("elbow", "upper", "lower", "continuous", "0 -1 0", "0 0.02 0.25", "0 1.2 0",
              inside='<limit velocity="2" effort="9"/>'),
        joint("weld", "lower", "flange", "fixed", xyz="0 0 0.22", rpy="0 0 1", inside=""),
        joint("weld2", "flange", "palm", "fixed", xyz="0 0 0.02", inside=""),
        joint("grip", "palm", "left", "prismatic", "1 0 0", "0 0 0.05", inside=finger),
        joint("grip2", "palm", "right", "prismatic", "-1 0 0", "0 0 0.05", inside=finger + '<mimic joint="grip"/>'),
    )  # fmt: skip


def pose(xyz, rotation=None):
    found = np.eye(4)
    found[:3, 3] = xyz
    if rotation is not None:
        found[:3, :3] = rotation
    return found
