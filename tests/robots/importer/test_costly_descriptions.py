"""Descriptions and meshes that would need too much time or memory are refused in one sentence, within bounds."""

import os
import struct
import time

import numpy as np
import pytest

from dualbrain.cli.robot.read_description import read_description
from dualbrain.core.untrusted.bounded_process import ProcessLimits
from dualbrain.errors import ConfigurationError
from dualbrain.robots.assets.mesh_primitives import load_mesh
from dualbrain.robots.importer import kinematic_tree
from tests.robots.importer.urdf_builder import link_xml, urdf_xml, write_file

SMALL = ProcessLimits(memory_bytes=256 << 20, seconds=3.0)
MJCF = {
    "height field": '<asset><hfield name="h" nrow="30000" ncol="30000" size="1 1 1 1"/></asset>'
    '<worldbody><geom type="hfield" hfield="h"/></worldbody>',
    "texture": '<asset><texture name="t" type="2d" builtin="flat" width="60000" height="60000"/></asset>',
    "replicate": '<worldbody><replicate count="100000000" offset="0 0 1"><geom size="1"/></replicate></worldbody>',
    "nested replicate": "<worldbody>"
    + '<replicate count="1000" offset="0 0 1">' * 4
    + '<geom size="1"/>'
    + "</replicate>" * 4
    + "</worldbody>",
    "composite": '<worldbody><body><flexcomp type="grid" count="2000 2000 2000" name="f" radius=".01"/></body>'
    "</worldbody>",
    "memory": '<size memory="900G"/><worldbody><geom size="1"/></worldbody>',
}


@pytest.mark.parametrize("kind", MJCF)
def test_a_costly_mjcf_is_refused(tmp_path, monkeypatch, kind):
    monkeypatch.setattr(kinematic_tree, "LIMITS", SMALL)
    file = write_file(tmp_path, f"<mujoco>{MJCF[kind]}</mujoco>", "robot.xml")
    start = time.monotonic()
    with pytest.raises(ConfigurationError, match=r"robot\.xml") as refused:
        read_description(file)
    assert time.monotonic() - start < 20.0
    assert len(str(refused.value)) < 500


def test_an_ordinary_mjcf_is_read(tmp_path):
    text = """<mujoco model="arm"><asset><mesh name="m" vertex="0 0 0 1 0 0 0 1 0 0 0 1"/>
    <texture name="t" type="2d" builtin="checker" width="64" height="64"/></asset>
    <worldbody><body name="a"><geom type="mesh" mesh="m"/><body name="b"><joint name="j" axis="0 1 0" range="-90 90"/>
    <geom type="capsule" size=".1 .2"/></body></body></worldbody></mujoco>"""
    tree = read_description(write_file(tmp_path, text, "robot.xml"))
    assert [joint.name for joint in tree.joints if joint.kind == "revolute"] == ["j"]
    mesh = tree.links["a"].shapes[0].load_mesh()
    assert (len(mesh.vertices), len(mesh.faces)) == (4, 4)
    assert np.ptp(tree.links["b"].shapes[0].load_mesh().vertices[:, 2]) == pytest.approx(0.6, abs=0.01)


def test_a_costly_urdf_is_refused(tmp_path, monkeypatch):
    monkeypatch.setattr(kinematic_tree, "LIMITS", ProcessLimits(memory_bytes=64 << 20, seconds=3.0))
    file = write_file(tmp_path, urdf_xml(*(link_xml(f"a{k}") for k in range(60_000))))
    with pytest.raises(ConfigurationError, match=r"robot\.urdf"):
        read_description(file)


def stl(triangles):
    one = struct.pack("<12fH", 0, 0, 1, 0, 0, 0, 1, 0, 0, 0, 1, 0, 0)
    return b"\0" * 80 + struct.pack("<I", triangles) + one * triangles


@pytest.mark.parametrize(
    ("name", "data"),
    [
        ("large.stl", stl(400_000)),
        ("lying.stl", b"\0" * 80 + struct.pack("<I", 0xFFFFFFFF) + b"\0" * 500),
        (
            "lying.ply",
            b"ply\nformat binary_little_endian 1.0\nelement vertex 2000000000\nproperty float x\nend_header\n",
        ),
        ("lying.off", b"OFF\n2000000000 2000000000 0\n"),
        ("junk.obj", b"f 1/2/3 " * 100_000),
        ("deep.dae", b"<COLLADA>" + b"<a>" * 200_000),
    ],
)
def test_a_costly_or_lying_mesh_is_refused(tmp_path, name, data):
    (tmp_path / name).write_bytes(data)
    with pytest.raises(ConfigurationError, match=name.replace(".", r"\.")):
        load_mesh(tmp_path / name, np.ones(3), np.eye(4), ProcessLimits(memory_bytes=32 << 20, seconds=3.0))


def test_an_ordinary_mesh_is_read_and_scaled(tmp_path):
    (tmp_path / "a.stl").write_bytes(stl(1))
    mesh = load_mesh(tmp_path / "a.stl", np.full(3, 2.0), np.eye(4))
    assert mesh.vertices.max() == 2.0
    assert mesh.faces.shape == (1, 3)


@pytest.mark.parametrize("kind", ["fifo", "device", "folder"])
def test_a_special_file_is_refused_at_once(tmp_path, kind):
    path = tmp_path / "robot.urdf"
    match kind:
        case "fifo":
            os.mkfifo(path)
        case "device":
            path.symlink_to("/dev/zero")
        case _:
            path.mkdir()
    with pytest.raises(ConfigurationError, match="not a regular file"):
        read_description(path)
