"""Passages for a planner request: those about an object of the instruction come first and need no similar sentence."""

from zlib import crc32

import numpy as np
import pytest

from dualbrain.grounding.document_retrieval import Budget, named_objects, retrieve_passages
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.knowledge.library import Library, Submission
from dualbrain.memory.embedding.hashing_encoder import HashingEncoder

SUMMARY = """robot panda; holding nothing
red_cube: object, free_finger_axis across
grey_tin: object, free_finger_axis along
pink_tin: object, free_finger_axis along
clear_glass: object, fragile
blue_bowl: container
places: table_left"""


@pytest.mark.parametrize(
    ("instruction", "names"),
    [
        ("Put the red cube in the blue bowl.", ("red_cube",)),
        ("put the glass in the bowl", ("clear_glass",)),
        ("put the tin in the bowl", ()),
        ("put the grey tin beside the cube", ("grey_tin", "red_cube")),
        ("go home", ()),
    ],
)
def test_objects_are_named_by_all_words_or_by_a_noun_that_only_one_has(instruction, names):
    assert named_objects(instruction, SUMMARY) == names


class Unlike(HashingEncoder):
    """An encoder to which every text is unlike every other, except that all texts about lamps are alike."""

    id = "unlike"

    def encode(self, texts):
        rows = np.zeros((len(texts), self.dim), np.float32)
        for row, text in zip(rows, texts, strict=True):
            row[0 if "lamp" in text.lower() else 1 + crc32(text.encode()) % (self.dim - 1)] = 1.0
        return rows


@pytest.fixture
def library(tmp_path):
    opened = Library(tmp_path / "knowledge.sqlite", Unlike(), write=True)
    yield opened
    opened.close()


def add(library, name, text, trust="site"):
    library.add(Submission(file=f"{name}.md", data=text.encode(), trust=trust, kind="rule"), now=0.0)


def passages(library, instruction="put the glass in the blue bowl", **budget):
    registry = load_skill_registry("panda")
    return [one.text for one in retrieve_passages(library, instruction, SUMMARY, registry, Budget(**budget))]


GLASS, CUBE = "The clear glass must be gripped with at most 8 N.", "The red cube must be gripped with at most 9 N."


def test_a_rule_that_names_the_object_is_shown_though_its_sentence_is_unlike_the_instruction(library):
    add(library, "glass", f"# Rules\n\n{GLASS}\n")
    add(library, "cube", f"# Rules\n\n{CUBE}\n")
    assert passages(library) == [GLASS]
    assert passages(library, "put the red cube in the blue bowl") == [CUBE]
    assert passages(library, "go home") == []


def test_it_precedes_passages_that_are_only_similar(library):
    """The search ranks the others higher."""
    instruction = "put the glass in the blue bowl beside the lamp near the window"
    for number in range(3):
        add(library, f"lamp-{number}", f"# Lamps\n\nLamp {number}: put bowl beside blue lamp near window.\n")
    add(library, "glass", f"# Rules\n\n{GLASS}\n")
    assert "Lamp" in library.search(instruction, 1)[0].text
    shown = passages(library, instruction)
    assert shown[0] == GLASS
    assert len(shown) == 3


def test_part_of_a_word_is_no_name_and_unknown_sources_are_never_shown(library):
    add(library, "window", "# Rules\n\nThe nuclear glass front of the clear glassware must stay clean.\n")
    add(library, "web", f"# Rules\n\n{GLASS}\n", trust="unknown")
    assert passages(library) == []
