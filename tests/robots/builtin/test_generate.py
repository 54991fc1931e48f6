"""The command that makes the data file: refuses unknown bodies, and repeats the stored file byte for byte."""

from importlib import resources

import pytest

from dualbrain.errors import UnknownName
from dualbrain.robots.builtin.generate import FACTS, encode, main
from dualbrain.robots.loader import load_body


def stored(name="panda"):
    return resources.files("dualbrain.robots").joinpath("data", f"{name}.json").read_bytes()


@pytest.mark.parametrize("name", FACTS)
def test_the_stored_file_is_in_the_form_the_command_writes(name):
    assert encode(load_body(name)) == stored(name)


def test_an_unknown_body_is_refused(tmp_path):
    with pytest.raises(UnknownName):
        main(["ur99", "--out", str(tmp_path / "x.json")])


@pytest.mark.slow
def test_the_command_repeats_the_stored_file(tmp_path, capsys):
    assert main(["panda", "--out", str(tmp_path / "panda.json")]) == 0
    assert (tmp_path / "panda.json").read_bytes() == stored()
    assert "104 spheres" in capsys.readouterr().err
