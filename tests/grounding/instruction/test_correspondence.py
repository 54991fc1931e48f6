"""A contract about objects, places or motions that the instruction does not mention is rejected."""

import numpy as np
import pytest

from dualbrain.adaptation.synthetic.instruction import draw_instruction
from dualbrain.adaptation.synthetic.templates import load_templates
from dualbrain.contracts.contract import Action, Context, Contract
from dualbrain.grounding.instruction.correspondence import INSTRUCTION_POINTER, SceneVocabulary, find_mismatch
from dualbrain.grounding.vocabulary import scene_names_of_spec
from dualbrain.runtime.data_collection.synthetic_scenes import load_phrasings
from dualbrain.simulation.scenes.generators.catalogue import open_scene

TABLE = ("blue_bowl", "table_left", "table_right", "table_front")
SORTING = SceneVocabulary(("red_cube", "green_tin", "red_block", "yellow_block"), TABLE)
BARE = SceneVocabulary(("red_cube",), TABLE)
GLASS = SceneVocabulary(("red_cube", "white_bottle", "clear_glass"), TABLE)
HOLDING = SceneVocabulary(("red_cube", "green_tin"), TABLE, "green_tin")
HOME = ("home", {})
RELEASE = ("release", {})


def grasp(name):
    return "grasp", {"object": name}


def place(name):
    return "place", {"destination": name}


def push(name, destination):
    return "push", {"object": name, "destination": destination}


def look(name):
    return "move_to", {"target": name}


def contract(*steps):
    return Contract("c-0001", Context("panda", "0" * 8), tuple(Action(skill, params) for skill, params in steps))


MISMATCHES = [
    ("hit the person's arm", BARE, [push("red_cube", "blue_bowl")]),
    ("asdf qwer zxcv", BARE, [grasp("red_cube"), place("blue_bowl")]),
    ("asdf qwer zxcv", BARE, [HOME]),
    ("", BARE, [grasp("red_cube")]),
    ("put the banana in the bowl", BARE, [grasp("red_cube"), place("blue_bowl")]),
    ("put the red cube in the drawer", BARE, [grasp("red_cube"), place("blue_bowl")]),
    ("put the red cube in the box", BARE, [grasp("red_cube"), place("blue_bowl")]),
    ("put the red cube in the green bowl", BARE, [grasp("red_cube"), place("blue_bowl")]),
    ("put the blue cube in the bowl", BARE, [grasp("red_cube"), place("blue_bowl")]),
    ("put the red cube in the bowl", BARE, [grasp("red_cube"), place("table_left")]),
    ("put the red cube in the bowl", BARE, [grasp("red_cube"), place("blue_bowl"), HOME]),
    ("put all the red things in the bowl", SORTING, [grasp("red_cube"), place("blue_bowl"), grasp("yellow_block")]),
    ("put the green block in the bowl", SORTING, [grasp("red_block")]),
    ("put the block in the bowl", SORTING, [grasp("red_block")]),
    ("pick it up", SORTING, [grasp("red_cube")]),
    ("sing a song", BARE, [look("red_cube")]),
    ("hover over the red cube", BARE, [grasp("red_cube"), place("blue_bowl")]),
    ("Bring your empty hand above the red cube and just wait there.", BARE, [grasp("red_cube"), place("blue_bowl")]),
    ("tidy the table, all that is yellow goes in the blue bowl", SORTING, [grasp("green_tin"), place("blue_bowl")]),
    ("leave nothing red lying on the table", SORTING, [grasp("yellow_block"), place("blue_bowl")]),
    ("shift the clear glass somewhere towards the left side of the table", GLASS, [grasp("white_bottle")]),
    ("what time is it", BARE, [look("red_cube")]),
    ("look at the person", BARE, [look("red_cube")]),
    ("wave at me", BARE, [HOME]),
]
MATCHES = [
    ("remove the red cube", BARE, [grasp("red_cube"), place("table_left")]),
    ("get rid of the red cube", BARE, [grasp("red_cube"), place("table_left")]),
    ("pick the red cube up and put it down somewhere else", BARE, [grasp("red_cube"), place("table_left")]),
    ("let go of the green tin", HOLDING, [place("table_left")]),
    ("put everything in the blue plastic bowl", SORTING, [grasp("green_tin"), place("blue_bowl")]),
    ("put everything transparent in the bowl", GLASS, [grasp("clear_glass"), place("blue_bowl")]),
    ("put it in the bowl", BARE, [grasp("red_cube"), place("blue_bowl")]),
    ("put the brick in the dish", BARE, [grasp("red_cube"), place("blue_bowl")]),
    ("put the red cub in the bowll", BARE, [grasp("red_cube"), place("blue_bowl")]),
    ("RED CUBE -> BLUE BOWL", BARE, [grasp("red_cube"), place("blue_bowl")]),
    ("tidy the red cube away", BARE, [grasp("red_cube"), place("blue_bowl")]),
    ("take the red cube out of the bowl", BARE, [grasp("red_cube"), place("table_left")]),
    ("put the red cube in the bowl and retract", BARE, [grasp("red_cube"), place("blue_bowl"), HOME]),
    ("hover over the bowl", BARE, [look("blue_bowl")]),
    ("put the cube in the bowl", SORTING, [grasp("red_cube"), place("blue_bowl")]),
    ("put all the blocks in the bowl", SORTING, [grasp("red_block"), place("blue_bowl"), grasp("yellow_block")]),
    ("put the red and yellow blocks in the bowl", SORTING, [grasp("red_block"), grasp("yellow_block")]),
    ("put everything in the bowl", SORTING, [grasp("green_tin"), place("blue_bowl")]),
    ("place a block in the bowl", SORTING, [grasp("red_block"), place("blue_bowl")]),
    ("put the cup on the right side of the table", GLASS, [grasp("clear_glass"), place("table_right")]),
    ("put the transparent glass at the front of the table", GLASS, [grasp("clear_glass"), place("table_front")]),
    ("could you drop it", HOLDING, [RELEASE]),
    ("asdf", BARE, [("hold", {"duration": 0.5})]),
    ("asdf", BARE, [("decline", {"reason": "no"})]),
]


@pytest.mark.parametrize(("text", "scene", "steps"), MISMATCHES)
def test_a_contract_about_something_else_is_rejected_with_a_question_or_a_hint(text, scene, steps):
    rejected = find_mismatch(contract(*steps), text, scene)
    assert rejected is not None
    assert rejected.pointer == INSTRUCTION_POINTER
    assert "which one do you mean" in rejected.hint or "leave" in rejected.hint


@pytest.mark.parametrize(("text", "scene", "steps"), MATCHES)
def test_a_contract_about_the_words_passes(text, scene, steps):
    assert find_mismatch(contract(*steps), text, scene) is None


FAMILIES = {
    "panda": ("bare", "tabletop", "tall", "shelf", "forearm", "edge", "fragile", "sorting"),
    "ur5e": ("tabletop", "sorting"),
    "base": ("boxes", "crossing", "aisles"),
    "mobile_panda": ("workroom", "busy_workroom"),
}


@pytest.mark.parametrize("robot", FAMILIES)
def test_the_right_contract_of_every_packaged_sentence_passes(robot):
    rng, rejected = np.random.default_rng(3), []
    for family in FAMILIES[robot]:
        for part in ("teach", "test"):
            names = scene_names_of_spec(open_scene(f"{family}:{int(rng.integers(40))}", robot))
            scene = SceneVocabulary(names.graspable, names.receptive)
            phrasings = load_phrasings(robot == "base", part)
            for _ in range(300):
                task = draw_instruction(names, robot == "base", load_templates(), phrasings, rng)
                if task is None or not task.is_possible:
                    continue
                mismatch = find_mismatch(contract(*task.steps), task.sentence, scene)
                if mismatch is not None:
                    rejected.append((family, task.sentence, mismatch.hint))
    assert rejected == []
