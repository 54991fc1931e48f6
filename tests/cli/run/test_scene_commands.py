"""`dualbrain scenes` and `scene show`: every family is listed, and a scene is a table with an image."""

import pytest

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.simulation.scenes.generators.catalogue import describe_families, open_scene


@pytest.mark.parametrize("robot", ["panda", "base", "mobile_panda"])
def test_every_family_is_listed_with_its_content(run_command, monkeypatch, robot):
    monkeypatch.setenv("COLUMNS", "200")
    code, out, _ = run_command("scenes", "--robot", robot)
    assert code == ExitCode.SUCCESS
    for family in describe_families(robot):
        assert family.description.rstrip(".") in out
        assert any(line.startswith(family.name) for line in out.splitlines())


def test_a_number_means_the_family_that_the_list_states():
    for family in describe_families("panda"):
        for number in filter(str.isdigit, family.numbers.split(", ")):
            assert open_scene(number).family == family.name


def test_a_scene_is_shown_with_every_object_and_an_image(run_command, tmp_path):
    code, out, err = run_command("scene", "show", "forearm:2", "--image", "a.png")
    spec = open_scene("forearm:2")
    assert code == ExitCode.SUCCESS
    for name in (*(one.name for one in spec.objects), *(one.name for one in spec.places), "forearm"):
        assert name in out
    assert "cm/s" in out
    if "no image" not in err:
        assert (tmp_path / "a.png").read_bytes().startswith(b"\x89PNG")


def test_a_file_that_is_no_scene_file_and_a_room_are_refused(run_command):
    assert run_command("scene", "new", "mine.txt")[0] == ExitCode.USAGE
    code, _, err = run_command("scene", "new", "mine.json", "--robot", "base", "--scene", "boxes:0")
    assert code == ExitCode.SETUP
    assert "room" in err


@pytest.mark.parametrize("command", [("scenes",), ("scene", "show", "0", "--no-image"), ("scene", "new", "mine.json")])
def test_a_robot_without_scenes_is_refused(run_command, command):
    code, out, err = run_command(*command, "--robot", "so101")
    assert (code, out) == (ExitCode.SETUP, "")
    assert "so101 has no scenes" in err
    assert "panda, fr3, ur5e, ur5e_lean, base, mobile_panda" in " ".join(err.split())


def test_an_unknown_robot_is_answered_with_the_closest(run_command):
    code, _, err = run_command("scenes", "--robot", "pandas")
    assert code == ExitCode.SETUP
    assert "Closest: 'panda'" in err
