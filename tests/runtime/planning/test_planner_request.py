"""A request shows make_exemplar contracts in the form in which a planner generates them."""

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
from dualbrain.runtime.planning.planner_request import PlanningContext, build_request, in_prompt_order
from dualbrain.simulation.perception.noisy_perception import NO_NOISE, NoisyPerception
from dualbrain.simulation.plant.factory import make_plant
from dualbrain.simulation.scenes.generators.tabletop import make_scene


def make_exemplar(contract):
    """An exemplar as read from a ledger, whose keys are sorted."""
    stored = json.loads(json.dumps(json.loads(contract), sort_keys=True))
    return Exemplar(
        episode_id="e",
        instruction="words",
        summary="scene",
        contract=stored,
        succeeded=True,
        Delta=0.001,
        similarity=0.9,
        weight=0.5,
        score=0.8,
        rank=1,
    )


def test_an_exemplar_has_exactly_the_form_of_a_training_answer():
    for robot in ("panda", "base"):
        registry = load_skill_registry(robot)
        for one in generate_examples(5, "teach", 3, {robot: 1.0}, exemplar_share=0.0):
            recall = in_prompt_order(
                RetrievedContext((make_exemplar(one.contract),), (make_exemplar(one.contract),)), registry
            )
            for shown in (recall.exemplars[0], recall.warnings[0]):
                assert exemplar_steps(shown.contract) in one.contract
                contract = msgspec.convert(shown.contract, Contract)
                assert canonical_contract(contract, registry) == one.contract


def test_a_request_contains_exemplars_in_that_form():
    robot_model, spec = load_robot("panda"), make_scene("tabletop", 1)
    scene = NoisyPerception(spec, NO_NOISE, np.random.default_rng(0)).perceive(
        make_plant(spec, robot_model, visuals=False)
    )
    context = PlanningContext(
        robot_model=robot_model, scene=scene, holding=None, posture=Posture(tuple(robot_model.home), 0.04)
    )
    (one,) = generate_examples(1, "teach", 3, {"panda": 1.0}, exemplar_share=0.0)
    request = build_request("words", context, RetrievedContext((make_exemplar(one.contract),)))
    assert exemplar_steps(request.recall.exemplars[0].contract) in one.contract


def test_a_rejected_contract_with_unknown_skills_is_shown_unchanged():
    odd = '{"action_sequence":[{"skill":"fly","params":{"b":1,"a":2}},"?"]}'
    recall = in_prompt_order(RetrievedContext(warnings=(make_exemplar(odd),)), load_skill_registry("panda"))
    assert recall.warnings[0].contract == json.loads(odd)
