"""Small URDF descriptions for tests, built from links and joints."""

import textwrap
from pathlib import Path

import numpy as np

from dualbrain.robots.importer.required_limits import LimitPolicy, StatedLimit

SOURCE = "test"


def limit_policy(acceleration=10.0, **limits):
    all_joints = {"acceleration": StatedLimit(acceleration, SOURCE)} | {
        name: StatedLimit(value, SOURCE) for name, value in limits.items()
    }
    return LimitPolicy(all_joints, {}, {"period": StatedLimit(0.002, SOURCE), "tool_speed": StatedLimit(0.25, SOURCE)})


def link_xml(name, size=(0.05, 0.05, 0.2), at=(0, 0, 0.1)):
    shape = f'<geometry><box size="{size[0]} {size[1]} {size[2]}"/></geometry>'
    origin = f'<origin xyz="{at[0]} {at[1]} {at[2]}"/>'
    return f'<link name="{name}"><collision>{origin}{shape}</collision></link>'


def joint_xml(name, parent, child, kind="revolute", axis="0 1 0", xyz="0 0 0.2", rpy="0 0 0", inside=None):
    limit = '<limit lower="-2" upper="2" velocity="1.5" effort="9"/>' if inside is None else inside
    return (
        f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
        f'<origin xyz="{xyz}" rpy="{rpy}"/><axis xyz="{axis}"/>{limit}</joint>'
    )


def urdf_xml(*parts, name="Test Arm-7"):
    return f'<?xml version="1.0"?>\n<robot name="{name}">\n' + "\n".join(parts) + "\n</robot>\n"


def write_file(folder, text, name="robot.urdf"):
    path = Path(folder) / name
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(textwrap.dedent(text))
    return path


def full_featured_arm():
    """Prismatic, revolute and continuous joints on oblique axes, a fixed flange, and a hand with a mimic finger."""
    finger = '<limit lower="0" upper="0.04" velocity="0.1" effort="9"/>'
    return urdf_xml(
        link_xml("base"),
        link_xml("column"),
        link_xml("upper"),
        link_xml("lower"),
        link_xml("flange", (0.04, 0.04, 0.02), (0, 0, 0.01)),
        link_xml("palm", (0.1, 0.04, 0.04), (0, 0, 0.03)),
        link_xml("left", (0.01, 0.02, 0.05), (0, 0, 0.025)),
        link_xml("right", (0.01, 0.02, 0.05), (0, 0, 0.025)),
        joint_xml(
            "lift",
            "base",
            "column",
            "prismatic",
            "0 0 1",
            "0.1 0 0.3",
            inside='<limit lower="0" upper="0.5" velocity="0.2" effort="9"/>',
        ),
        joint_xml("shoulder", "column", "upper", axis="1 2 -0.5", xyz="0.1 0.05 0.2", rpy="0.3 -0.2 0.7"),
        joint_xml(
            "elbow",
            "upper",
            "lower",
            "continuous",
            "0 -1 0",
            "0 0.02 0.25",
            "0 1.2 0",
            inside='<limit velocity="2" effort="9"/>',
        ),
        joint_xml("weld", "lower", "flange", "fixed", xyz="0 0 0.22", rpy="0 0 1", inside=""),
        joint_xml("weld2", "flange", "palm", "fixed", xyz="0 0 0.02", inside=""),
        joint_xml("grip", "palm", "left", "prismatic", "1 0 0", "0 0 0.05", inside=finger),
        joint_xml("grip2", "palm", "right", "prismatic", "-1 0 0", "0 0 0.05", inside=finger + '<mimic joint="grip"/>'),
    )


def transform(xyz, rotation=None):
    pose = np.eye(4)
    pose[:3, 3] = xyz
    if rotation is not None:
        pose[:3, :3] = rotation
    return pose
