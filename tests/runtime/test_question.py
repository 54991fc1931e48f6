"""A question shows what was done before in the words in which a planner answers."""

import json

import msgspec

from dualbrain.contracts.canonical_contract import canonical_contract
from dualbrain.contracts.contract import Contract
from dualbrain.planner.short_prompt import exemplar_steps
from dualbrain.records import Exemplar, Recall
from dualbrain.runtime.classroom import lessons
from dualbrain.runtime.question import as_written
from dualbrain.runtime.vocabulary import vocabulary


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


def test_a_refused_contract_of_other_skills_is_shown_as_it_was():
    odd = '{"action_sequence":[{"skill":"fly","params":{"b":1,"a":2}},"?"]}'
    recall = as_written(Recall(warnings=(remembered(odd),)), vocabulary("panda"))
    assert recall.warnings[0].contract == json.loads(odd)
