"""The scene generators still produce the reported scenes; another scene under the same name is rejected."""

import msgspec
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.simulation.tasks.families import LEVELS, TASK_FAMILIES, make_task, task_families_for
from dualbrain.simulation.tasks.scene_hashes import (
    HASH_FILE,
    check_scene_hash,
    expected_hash,
    format_hash_file,
    scene_hash,
)

FIRST, COUNT = 40_000, 50


def test_every_generator_still_produces_the_reported_scenes():
    assert format_hash_file(range(FIRST, FIRST + COUNT)) == HASH_FILE.read_text(encoding="utf-8")


def test_every_family_and_level_has_hashes_without_duplicates():
    for family in TASK_FAMILIES:
        for level in LEVELS:
            found = [expected_hash(family, level, seed) for seed in range(FIRST, FIRST + COUNT)]
            assert len(set(found)) == COUNT
            assert expected_hash(family, level, FIRST - 1) is None
            assert expected_hash(family, level, FIRST + COUNT) is None


@pytest.mark.parametrize("family", task_families_for("ur5e"))
def test_the_hash_is_the_same_for_both_arms(family):
    spec = make_task(family, "II", FIRST + 3, "ur5e").spec
    check_scene_hash(family, "II", FIRST + 3, spec)
    assert scene_hash(spec) == expected_hash(family, "II", FIRST + 3)


def test_moving_an_object_by_two_micrometres_changes_the_hash():
    spec = make_task("edge_rescue", "II", FIRST, "panda").spec
    obj = spec.objects[1]
    x, y, z = obj.position
    for shift, same in ((1e-8, True), (2e-6, False)):
        moved = msgspec.structs.replace(obj, position=(x, y, z + shift))
        other = msgspec.structs.replace(spec, objects=(spec.objects[0], moved, *spec.objects[2:]))
        assert (scene_hash(other) == scene_hash(spec)) is same
    with pytest.raises(ConfigurationError, match="edge_rescue"):
        check_scene_hash("edge_rescue", "II", FIRST, other)
    check_scene_hash("edge_rescue", "II", 5, other)
