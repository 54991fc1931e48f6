"""A question shows what was done before in the words in which a planner answers."""

import json

import msgspec
import numpy as np

from dualbrain.contracts.canonical_form import canonical_contract
from dualbrain.contracts.contract import Contract
from dualbrain.grounding.vocabulary import vocabulary
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.planner.prompt.short_prompt import exemplar_steps
from dualbrain.records import Exemplar, Recall
from dualbrain.robots.loader import load_body
from dualbrain.runtime.data_collection.synthetic_scenes import lessons
from dualbrain.runtime.planner_request import Standpoint, as_written, question
from dualbrain.simulation.perception.noisy_perception import EXACT, Perception
from dualbrain.simulation.plant.factory import open_plant
from dualbrain.simulation.scenes.generators.tabletop import make_scene


def remembered(contract):
    """An exemplar as it comes back from a ledger, where keys are sorted."""
    kept = json.loads(json.dumps(json.loads(contract), sort_keys=True))
    return Exemplar("e", "words", "scene", kept, True, 0.001, 0.9, 0.5, 0.8, 1)


def test_an_example_from_memory_reads_to_the_letter_as_the_answer_that_was_taught():
    for robot in ("panda", "base"):
        registry = vocabulary(robot)
        for one in lessons(5, "teach", 3, {robot: 1.0}, exemplars=0.0):
            recall = as_written(Recall((remembered(one.contract),), (remembered(one.contract),)), registry)
            for shown in (recall.exemplars[0], recall.warnings[0]):
                assert exemplar_steps(shown.contract) in one.contract
                contract = msgspec.convert(shown.contract, Contract)
                assert canonical_contract(contract, registry) == one.contract


def test_a_question_holds_what_was_recalled_in_that_order():
    body, spec = load_body("panda"), make_scene("tabletop", 1)
    scene = Perception(spec, EXACT, np.random.default_rng(0)).look(open_plant(spec, body, visuals=False))
    here = Standpoint(body, scene, None, Posture(tuple(body.home), 0.04))
    (one,) = lessons(1, "teach", 3, {"panda": 1.0}, exemplars=0.0)
    asked = question("words", here, Recall((remembered(one.contract),)))
    assert exemplar_steps(asked.recall.exemplars[0].contract) in one.contract


def test_a_refused_contract_of_other_skills_is_shown_as_it_was():
    odd = '{"action_sequence":[{"skill":"fly","params":{"b":1,"a":2}},"?"]}'
    recall = as_written(Recall(warnings=(remembered(odd),)), vocabulary("panda"))
    assert recall.warnings[0].contract == json.loads(odd)
