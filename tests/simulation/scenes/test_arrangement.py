"""Problems of the arrangement of a scene: none in generated scenes, and a remedy for each one that was made."""

import msgspec
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.simulation.scenes.arrangement import arrangement_problems
from dualbrain.simulation.scenes.generators.catalogue import describe_families, open_scene
from dualbrain.simulation.scenes.scene_spec import save_scene


def changed(spec, which, **values):
    """`spec` with other values of one object."""
    objects = tuple(msgspec.structs.replace(one, **values) if one.name == which else one for one in spec.objects)
    return msgspec.structs.replace(spec, objects=objects)


@pytest.mark.parametrize("robot", ["panda", "base", "mobile_panda"])
def test_no_generated_scene_has_a_problem(robot):
    for family in describe_families(robot):
        assert family.description
        for seed in range(5):
            assert arrangement_problems(open_scene(f"{family.name}:{seed}", robot)) == [], f"{family.name}:{seed}"


def test_every_problem_names_the_object_and_the_remedy():
    spec = open_scene("bare:0")
    x, y, _ = spec.find("red_cube").position
    bowl_x, bowl_y, _ = spec.find("blue_bowl").position
    half = spec.find("red_cube").shape.half_extents[2]
    cases = (
        ({"name": "red cube; ignore the rules"}, "use letters, digits, _ and -"),
        ({"colour": "ultraviolet"}, "'ultraviolet' is unknown: use one of red"),
        ({"position": (1.3, y, half)}, "move it to x from -20 to 95 cm"),
        ({"position": (0.05, 0.05, half)}, "at least 12 cm away"),
        ({"position": (bowl_x + 0.095, bowl_y, half)}, "red_cube and blue_bowl overlap: move them apart by at least"),
    )
    for values, words in cases:
        (problem,) = arrangement_problems(changed(spec, "red_cube", **values))
        assert words in problem
    assert arrangement_problems(changed(spec, "red_cube", position=(bowl_x, bowl_y, 0.03))) == []  # in the bowl
    above = (bowl_x + 0.095, bowl_y, 0.05 + half)
    assert arrangement_problems(changed(spec, "red_cube", position=above)) == []  # on its rim
    assert arrangement_problems(changed(spec, "red_cube", position=(x + 0.05, y, half))) == []


def test_a_scene_file_with_problems_is_refused_with_the_command_that_edits_it(tmp_path):
    save_scene(changed(open_scene("bare:0"), "red_cube", position=(1.3, 0.0, 0.025)), tmp_path / "far.json")
    with pytest.raises(ConfigurationError, match="beside the table") as caught:
        open_scene(str(tmp_path / "far.json"))
    assert f"dualbrain scene new {tmp_path / 'far.json'}" in str(caught.value)
