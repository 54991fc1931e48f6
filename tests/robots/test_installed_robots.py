"""Robots of other packages: found by entry point, checked, and never in place of a packaged robot."""

import sys

import pytest

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.robots.loader import encode_robot, installed_robots, load_builtin_robot, load_robot

MODULE = """
import msgspec
from dualbrain.robots.loader import load_robot

def load_arm():
    return msgspec.structs.replace(load_robot("ur5e"), name="arm")

def load_wrong():
    return msgspec.structs.replace(load_robot("ur5e"), period=-1.0)

def fail():
    raise OSError("the disk is gone")

model = load_arm()
path = __file__.replace("some_robots.py", "body.json")
number = 7
"""
ENTRIES = """
[dualbrain.robots]
arm = some_robots:load_arm
model = some_robots:model
file = some_robots:path
panda = some_robots:load_arm
wrong = some_robots:load_wrong
failing = some_robots:fail
number = some_robots:number
absent = no_such_module:load
"""


@pytest.fixture(autouse=True)
def package(tmp_path, monkeypatch):
    """An installed package with robots."""
    (tmp_path / "some_robots.py").write_text(MODULE)
    (tmp_path / "body.json").write_bytes(encode_robot(load_robot("ur5e")))
    folder = tmp_path / "some_robots-1.0.dist-info"
    folder.mkdir()
    (folder / "METADATA").write_text("Metadata-Version: 2.1\nName: some-robots\nVersion: 1.0\n")
    (folder / "entry_points.txt").write_text(ENTRIES)
    monkeypatch.syspath_prepend(str(tmp_path))
    yield
    sys.modules.pop("some_robots", None)


@pytest.mark.parametrize(("name", "expected"), [("arm", "arm"), ("model", "arm"), ("file", "ur5e")])
def test_a_robot_of_another_package_is_loaded_by_its_name(name, expected):
    assert load_robot(name).name == expected


def test_a_packaged_robot_is_never_replaced():
    assert "panda" in installed_robots()
    assert load_robot("panda").name == "panda"


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("wrong", "period of the installed robot wrong"),
        ("failing", "'failing' of the package some-robots cannot be loaded: OSError: the disk is gone"),
        ("number", "robot 'number' of the package some-robots: got 'int'"),
        ("absent", "cannot be loaded: ModuleNotFoundError"),
    ],
)
def test_a_robot_that_is_not_usable_is_refused_with_its_package(name, message):
    with pytest.raises(ConfigurationError, match=message):
        load_robot(name)


def test_an_unknown_name_is_refused_with_the_installed_robots():
    with pytest.raises(UnknownNameError) as caught:
        load_robot("armm")
    assert {"arm", "panda", "ur5e"} <= set(caught.value.known)


def test_names_in_files_never_load_another_package():
    with pytest.raises(UnknownNameError):
        load_builtin_robot("arm")
