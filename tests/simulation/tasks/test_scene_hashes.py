"""The reported scenes are those that were frozen; another scene under the same name is refused."""

import msgspec
import pytest

from dualbrain.errors import InvalidSetup
from dualbrain.simulation.tasks.families import FAMILIES, LEVELS, assign, families_of
from dualbrain.simulation.tasks.scene_hashes import FILE, check_frozen, frozen_hash, frozen_table, scene_hash

FIRST, COUNT = 40_000, 50


def test_every_generator_still_makes_the_frozen_scenes():
    assert frozen_table(range(FIRST, FIRST + COUNT)) == FILE.read_text(encoding="utf-8")


def test_every_family_and_level_is_frozen_and_no_scene_twice():
    for family in FAMILIES:
        for level in LEVELS:
            found = [frozen_hash(family, level, seed) for seed in range(FIRST, FIRST + COUNT)]
            assert len(set(found)) == COUNT
            assert frozen_hash(family, level, FIRST - 1) is None
            assert frozen_hash(family, level, FIRST + COUNT) is None


@pytest.mark.parametrize("family", families_of("ur5e"))
def test_the_hash_is_that_of_either_arm(family):
    spec = assign(family, "II", FIRST + 3, "ur5e").spec
    check_frozen(family, "II", FIRST + 3, spec)
    assert scene_hash(spec) == frozen_hash(family, "II", FIRST + 3)


def test_a_thing_that_moved_by_two_micrometres_is_another_scene():
    spec = assign("edge_rescue", "II", FIRST, "panda").spec
    thing = spec.things[1]
    x, y, z = thing.position
    for shift, same in ((1e-8, True), (2e-6, False)):
        moved = msgspec.structs.replace(thing, position=(x, y, z + shift))
        other = msgspec.structs.replace(spec, things=(spec.things[0], moved, *spec.things[2:]))
        assert (scene_hash(other) == scene_hash(spec)) is same
    with pytest.raises(InvalidSetup, match="edge_rescue"):
        check_frozen("edge_rescue", "II", FIRST, other)
    check_frozen("edge_rescue", "II", 5, other)
