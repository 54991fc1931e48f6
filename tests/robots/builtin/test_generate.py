"""The generator refuses unknown robots and reproduces the stored data file byte for byte."""

from importlib import resources

import pytest

from dualbrain.errors import UnknownNameError
from dualbrain.robots.builtin.generate import ARM_DEFINITIONS, encode_robot, main
from dualbrain.robots.loader import load_robot


def stored(name="panda"):
    return resources.files("dualbrain.robots").joinpath("data", f"{name}.json").read_bytes()


@pytest.mark.parametrize("name", ARM_DEFINITIONS)
def test_the_stored_file_has_the_format_of_the_generator(name):
    assert encode_robot(load_robot(name)) == stored(name)


def test_an_unknown_robot_is_refused(tmp_path):
    with pytest.raises(UnknownNameError):
        main(["ur99", "--out", str(tmp_path / "x.json")])


@pytest.mark.slow
def test_the_command_repeats_the_stored_file(tmp_path, capsys):
    assert main(["panda", "--out", str(tmp_path / "panda.json")]) == 0
    assert (tmp_path / "panda.json").read_bytes() == stored()
    assert "104 spheres" in capsys.readouterr().err
