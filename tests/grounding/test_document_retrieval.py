"""Passages for a planner request: those about an object of the instruction come first and need no similar sentence."""

import json
from zlib import crc32

import numpy as np
import pytest

from dualbrain.grounding.document_retrieval import Budget, named_objects, retrieve_passages, unshown_passages
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.knowledge.builtin_documents import BUILTIN_DOCUMENTS, add_builtin_documents
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


def test_passages_that_are_too_long_for_every_prompt_are_named(library):
    add(library, "signs", f"# Rules\n\nEach row: {'a < b, ' * 60}\n\nThe clear glass stays at its place.\n")
    (reason,) = unshown_passages(library, library.document("signs"))
    assert reason.startswith(str(library.chunks_of("signs")[0][0]))
    assert "a passage has at most 580" in reason
    assert passages(library, "put the signs of each row in the blue bowl") == []


def test_the_entries_of_rules_in_toml_are_split_so_that_all_can_be_shown(library):
    text = '[[rules]]\nname = "long"\nlines = [\n' + "".join(f'  "rule number {k}",\n' for k in range(60)) + "]\n"
    library.add(Submission(file="rules.toml", data=text.encode(), trust="site", kind="rule"), now=0.0)
    assert len(library.chunks_of("rules")) > 1
    assert unshown_passages(library, library.document("rules")) == ()


def test_of_the_packaged_documents_only_a_template_with_five_actions_is_never_shown(library):
    add_builtin_documents(library, now=0.0)
    found = [one for document in library.documents() for one in unshown_passages(library, document)]
    assert len(library.documents()) == len(BUILTIN_DOCUMENTS)
    assert found == [
        "template take_two_things: it has 672 characters in a prompt, and a passage has at most 580",
    ]


def test_templates_of_a_json_file_are_never_shown(library):
    home = {"name": "rest", "use_when": "Go home.", "slots": {}}
    home["action_sequence"] = [{"skill": "home", "params": {"speed": 0.2}}]
    data = {"kind": "template", "title": "Rest of the arm", "robots": ["panda"], "templates": [home]}
    library.add(Submission(file="rest.json", data=json.dumps(data).encode(), trust="site"), now=0.0)
    assert library.document("rest").kind == "template"
    assert passages(library, "go home", min_relevance=-1.0) == []
    assert unshown_passages(library, library.document("rest")) == (
        "all templates: only those of a TOML file are quoted",
    )
