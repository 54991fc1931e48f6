"""Clauses that contracts cannot express are found and quoted, and instructions without them pass."""

import time
import tomllib
from pathlib import Path

import pytest

from dualbrain.adaptation.synthetic.templates import load_templates
from dualbrain.grounding.instruction.clauses.clause_search import find_clauses
from dualbrain.grounding.instruction.clauses.expressible import capabilities
from dualbrain.grounding.instruction.review import Refusal, review_instruction
from dualbrain.grounding.instruction.words import normalise
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.simulation.tasks.instructions import find_task_kind, instruction_templates, task_kinds

SENTENCES = tomllib.loads(Path(__file__).with_name("sentences.toml").read_text(encoding="utf-8"))
PLACES = ("blue_bowl", "table_left", "table_right", "table_front", "aisle_left", "aisle_right", "shelf", "charger")
OBJECTS = ("red_cube", "green_tin", "brown_tin", "yellow_block", "clear_glass")
REGISTRIES = {name: load_skill_registry(name) for name in ("panda", "ur5e", "base", "mobile_panda")}
ABILITIES = {name: capabilities(registry) for name, registry in REGISTRIES.items()}
SLOTS = {
    "object": "red cube",
    "target": "blue bowl",
    "second": "green tin",
    "second_target": "left side of the table",
    "group": "red things",
    "number": "5",
}
BASE_SLOTS = SLOTS | {"target": "shelf", "second_target": "charger"}


def clauses(text, robot="mobile_panda"):
    return find_clauses(normalise(text), ABILITIES[robot], PLACES)


@pytest.mark.parametrize("text", SENTENCES["clauses"])
def test_a_clause_is_found_and_quoted_from_the_words(text):
    found = clauses(text)
    assert found, text
    assert found[0].quote in " ".join(text.split()).replace("\u2019", "'")


@pytest.mark.parametrize("text", SENTENCES["plain"])
def test_an_instruction_without_a_clause_passes(text):
    assert clauses(text) == ()


def in_scenes(part):
    """The sentences of one part that depend on a scene, with the scene."""
    return [(scene, text) for scene, group in SENTENCES["scenes"].items() for text in group[part]]


def clauses_in(scene, text):
    group = SENTENCES["scenes"][scene]
    return find_clauses(normalise(text), ABILITIES[group["robot"]], group["receptive"], group["graspable"])


@pytest.mark.parametrize(("scene", "text"), in_scenes("clauses"))
def test_a_clause_is_found_in_the_scene(scene, text):
    found = clauses_in(scene, text)
    assert found
    assert found[0].quote in text


@pytest.mark.parametrize(("scene", "text"), in_scenes("plain"))
def test_an_instruction_that_the_scene_makes_clear_passes(scene, text):
    group = SENTENCES["scenes"][scene]
    assert clauses_in(scene, text) == ()
    assert review_instruction(text, REGISTRIES[group["robot"]], group["receptive"], group["graspable"]) is None


@pytest.mark.parametrize(
    ("text", "one", "several"),
    [
        ("put the tin on the left into the bowl", ["red_tin", "red_cube"], ["red_tin", "green_tin"]),
        ("put both tins in the bowl", ["red_tin", "green_tin"], ["red_tin", "green_tin", "gray_tin"]),
        ("put the tin in the bowl, not the cube", ["red_tin", "red_cube"], ["red_tin", "green_tin", "red_cube"]),
    ],
)
def test_the_same_words_are_a_clause_where_the_objects_leave_a_choice(text, one, several):
    def found(graspable):
        return find_clauses(normalise(text), ABILITIES["panda"], ["blue_bowl", "table_left"], graspable)

    assert found(one) == ()
    assert found(several)
    assert found([])  # without the objects of the scene, nothing is known to be unambiguous


def test_a_comparison_is_named_by_its_own_words():
    text = "move the taller of the two bottles to the left side"
    for bottles in (["red_bottle", "gray_bottle"], ["red_bottle", "gray_bottle", "teal_bottle"]):
        found = find_clauses(normalise(text), ABILITIES["panda"], ["table_left"], bottles)
        assert (found[0].kind, found[0].quote[:6]) == ("comparison", "taller")


def packaged_sentences():
    """Every packaged sentence that a robot can carry out, with the robots that it suits."""
    for name in task_kinds(label="possible"):
        kind = find_task_kind(name)
        robots = ("base", "mobile_panda") if kind.bodies == "base" else ("panda", "ur5e", "mobile_panda")
        for template in instruction_templates(name):
            for robot in robots:
                yield robot, name, template.text
    mobile = set(task_kinds(mobile=True)) - set(task_kinds(mobile=False))
    for name, kind in load_templates().kinds.items():
        robots = ("base",) if kind.robots == "base" or name in mobile else ("panda", "ur5e")
        if kind.contract:
            for sentence in (*kind.train_sentences, *kind.held_out):
                for robot in robots:
                    yield robot, name, sentence


def test_every_packaged_sentence_reaches_the_planner():
    refused = []
    for robot, kind, sentence in packaged_sentences():
        text = sentence.format(**(BASE_SLOTS if robot == "base" else SLOTS))
        answer = review_instruction(text, REGISTRIES[robot], PLACES)
        if isinstance(answer, Refusal) or (answer is not None and kind != "stop"):
            refused.append((robot, kind, text, answer))
    assert refused == []


@pytest.mark.parametrize(
    ("text", "kind", "quote"),
    [
        ("place the red cube to the left of the bowl", "relative place", "to the left of the bowl"),
        ("Hand me the red cube!", "handing over", "Hand me the red cube"),
        ("push it away from you", "relative place", "push it away from you"),
        ("put the cube in the bowl if nobody is near", "condition", "if nobody is near"),
        ("keep pushing the cube", "loop", "keep pushing the cube"),
        ("in five minutes, go home", "time", "in five minutes"),
        ("put two of the blocks in the bowl", "count", "two of the blocks"),
        ("put everything in the bowl except the tin", "exclusion", "except the tin"),
        ("Don\u2019t put the cube in the bowl", "exclusion", "Don't put the cube in the bowl"),
        ("put either the cube or the tin in the bowl", "alternative", "either the cube or the tin in the bowl"),
        ("put the biggest block in the bowl", "comparison", "biggest block"),
        ("turn the bottle over", "orientation", "turn the bottle over"),
        ("put the cube in the bowl untill it is ful", "loop", "untill it is ful"),
    ],
)
def test_the_refusal_names_kind_and_words(text, kind, quote):
    answer = review_instruction(text, REGISTRIES["panda"], PLACES)
    assert isinstance(answer, Refusal)
    assert f'"{quote}" ({kind})' in answer.reason
    assert "grasp" in answer.reason  # the skills that can be asked for instead
    assert len(answer.brief_reason) <= 120


@pytest.mark.parametrize(
    ("text", "able", "unable"),
    [
        ("wait for 5 seconds", "panda", "base"),
        ("push the cube 5 cm toward the bowl", "panda", "base"),
        ("if the bowl is empty, put the cube in it", "panda", "base"),
        ("turn until you face 1.5 rad", "base", "panda"),
    ],
)
def test_the_skills_of_the_robot_decide_which_clauses_can_be_expressed(text, able, unable):
    assert clauses(text, able) == ()
    assert clauses(text, unable)


def test_a_wait_beyond_the_bound_of_the_skill_is_a_clause():
    assert clauses("wait for 20 seconds", "panda") == ()
    assert [one.kind for one in clauses("wait for 21 seconds", "panda")] == ["time"]


def test_capital_letters_and_punctuation_change_nothing():
    for text in SENTENCES["clauses"][::7]:
        assert clauses(text.upper()), text
        assert clauses(f"  {text} !!"), text
    for text in SENTENCES["plain"][::7]:
        assert clauses(text.upper()) == (), text


def test_the_check_takes_less_than_5_ms():
    texts = [*SENTENCES["clauses"], *SENTENCES["plain"]]
    started = time.process_time()
    for text in texts:
        review_instruction(text, REGISTRIES["mobile_panda"], PLACES, OBJECTS)
    assert (time.process_time() - started) / len(texts) < 5e-3


def test_the_time_is_linear_in_the_length_of_the_text():
    def seconds(text):
        started = time.process_time()
        review_instruction(text, REGISTRIES["panda"], PLACES, OBJECTS)
        return time.process_time() - started

    units = ("put the red cube in the bowl and ", "a", "not ", "to the ", "push the cube ", "if ")
    units += ("from the left ", "the cube on the left ", "both cubes ", "do not leave it there ", "not the cube , ")
    units += ("it is not there , ", "I am sad if it rains . ", "the cube behind ", "the two ", "that is next to ")
    for unit in units:
        short, long = (min(seconds(unit * n) for _ in range(2)) for n in (400, 1600))
        assert long < 12 * max(short, 0.01), unit


@pytest.mark.parametrize(
    "addition",
    [
        "Never mind.",
        "I changed my mind.",
        "No.",
        "No!",
        "That was a joke.",
        "I was joking.",
        "I will do it myself.",
    ],
)
def test_a_request_that_is_withdrawn_is_declined(addition):
    text = f"put the red cube in the bowl. {addition}"
    (clause,) = find_clauses(normalise(text), capabilities(load_skill_registry("panda")), ("blue_bowl",), ("red_cube",))
    assert clause.kind == "exclusion"
    assert clause.quote in addition


@pytest.mark.parametrize(
    ("text", "declined"),
    [
        ("I don't want you to put the red cube in the bowl", True),
        ("I don't think you should put the red cube in the bowl", True),
        ("put none of the blocks in the bowl", True),
        ("put the red cube anywhere but in the bowl", True),
        ("I don't want it to break, so put the glass gently in the bowl", False),
        ("no, put the red cube in the bowl", False),
        ("never mind the mess, put the red cube in the bowl", False),
    ],
)
def test_a_request_that_is_refused_by_the_person_is_declined(text, declined):
    found = find_clauses(
        normalise(text), capabilities(load_skill_registry("panda")), ("blue_bowl",), ("red_cube", "glass")
    )
    assert bool(found) is declined
