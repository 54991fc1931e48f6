"""A question shows what was done before in the words in which a planner answers."""

import json

import msgspec
import numpy as np

from dualbrain.contracts.canonical_form import canonical_contract
from dualbrain.contracts.contract import Contract
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.planner.prompt.short_prompt import exemplar_steps
from dualbrain.records import Exemplar, RetrievedContext
from dualbrain.robots.loader import load_robot
from dualbrain.runtime.data_collection.synthetic_scenes import generate_examples
from dualbrain.runtime.planner_request import PlanningContext, build_request, in_prompt_order
from dualbrain.simulation.perception.noisy_perception import NO_NOISE, NoisyPerception
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.scenes.generators.tabletop import make_scene


def remembered(contract):
    """An exemplar as it comes back from a ledger, where keys are sorted."""
    kept = json.loads(json.dumps(json.loads(contract), sort_keys=True))
    return Exemplar(
        episode_id="e",
        instruction="words",
        summary="scene",
        contract=kept,
        succeeded=True,
        Delta=0.001,
        similarity=0.9,
        weight=0.5,
        score=0.8,
        rank=1,
    )


def test_an_example_from_memory_reads_to_the_letter_as_the_answer_that_was_taught():
    for robot in ("panda", "base"):
        registry = load_skill_registry(robot)
        for one in generate_examples(5, "teach", 3, {robot: 1.0}, exemplar_share=0.0):
            recall = in_prompt_order(
                RetrievedContext((remembered(one.contract),), (remembered(one.contract),)), registry
            )
            for shown in (recall.exemplars[0], recall.warnings[0]):
                assert exemplar_steps(shown.contract) in one.contract
                contract = msgspec.convert(shown.contract, Contract)
                assert canonical_contract(contract, registry) == one.contract


def test_a_question_holds_what_was_recalled_in_that_order():
    robot_model, spec = load_robot("panda"), make_scene("tabletop", 1)
    scene = NoisyPerception(spec, NO_NOISE, np.random.default_rng(0)).perceive(
        make_plant(spec, robot_model, visuals=False)
    )
    here = PlanningContext(
        robot_model=robot_model, scene=scene, holding=None, posture=Posture(tuple(robot_model.home), 0.04)
    )
    (one,) = generate_examples(1, "teach", 3, {"panda": 1.0}, exemplar_share=0.0)
    asked = build_request("words", here, RetrievedContext((remembered(one.contract),)))
    assert exemplar_steps(asked.recall.exemplars[0].contract) in one.contract


def test_a_refused_contract_of_other_skills_is_shown_as_it_was():
    odd = '{"action_sequence":[{"skill":"fly","params":{"b":1,"a":2}},"?"]}'
    recall = in_prompt_order(RetrievedContext(warnings=(remembered(odd),)), load_skill_registry("panda"))
    assert recall.warnings[0].contract == json.loads(odd)
