"""The instruction sets can be loaded, name only objects of their scenes, and refuse wrong entries."""

from __future__ import annotations

from collections import Counter

import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.simulation.scenes.generators.catalogue import open_scene
from experiments.evaluation.instructions.instruction_set import (
    CLAUSE_FILES,
    FREE_FILES,
    FreeInstruction,
    check_names,
    clause_instructions,
    content_hash,
    free_instructions,
    parse_free_instructions,
)

NEW_SEED = 80000


FREE = [one for name in FREE_FILES for one in free_instructions(name).instruction]


@pytest.mark.parametrize("one", FREE, ids=lambda one: one.id)
def test_every_free_instruction_is_about_its_new_scene(one: FreeInstruction) -> None:
    assert int(one.scene.partition(":")[2]) >= NEW_SEED
    check_names(one)


def test_the_sets_are_complete_and_without_repetition() -> None:
    clauses = [clause_instructions(name) for name in CLAUSE_FILES]
    assert [len(free_instructions(name).instruction) for name in FREE_FILES] == [80] * len(FREE_FILES)
    assert {(len(one.clause), len(one.plain)) for one in clauses} == {(60, 60)}
    texts = Counter(one.text.lower() for each in clauses for one in (*each.clause, *each.plain))
    assert max(texts.values()) == 1
    assert len({one.id for one in FREE}) == len({one.text.lower() for one in FREE}) == len(FREE)


@pytest.mark.parametrize("collection", CLAUSE_FILES)
def test_every_clause_instruction_is_about_an_existing_scene(collection: str) -> None:
    both = clause_instructions(collection)
    for one in (*both.clause, *both.plain):
        assert open_scene(one.scene, one.robot).objects


@pytest.mark.parametrize("collection", CLAUSE_FILES)
def test_the_words_that_name_a_clause_are_words_of_the_instruction(collection: str) -> None:
    for one in clause_instructions(collection).clause:
        assert any(name in one.text.lower() for name in one.names)


VALID = """
[reasons]
absent = ["there is no"]
[[instruction]]
id = "x"
text = "put the red cube in the blue bowl"
robot = "panda"
scene = "bare:80000"
kind = "put"
"""


@pytest.mark.parametrize(
    "wrong",
    [
        "",
        'decline = ["nothing of the kind"]',
        'done = [{ is = "in", object = "red_cube" }]',
        'done = [{ is = "in", any_of = ["red_cube"], at = "blue_bowl" }]',
        'done = [{ is = "under", object = "red_cube" }]',
        'done = [{ is = "home" }]\ncolour = "red"',
    ],
)
def test_a_wrong_entry_is_refused(wrong: str) -> None:
    with pytest.raises(ConfigurationError):
        parse_free_instructions(VALID + wrong)


def test_a_name_that_the_scene_lacks_is_refused() -> None:
    text = VALID + 'done = [{ is = "in", object = "green_tin", at = "blue_bowl" }]'
    (one,) = parse_free_instructions(text).instruction
    with pytest.raises(ConfigurationError, match="green_tin"):
        check_names(one)


def test_the_hash_names_the_content() -> None:
    assert content_hash("free.toml") != content_hash("clauses/first.toml")
