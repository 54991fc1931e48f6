"""Steps that only a recalled episode contains: removed from the prompt, and refused in a plan."""

import pytest

from dualbrain.grounding.instruction.recalled_steps import fit_recall, reject_recalled_step, unrequested_skills
from dualbrain.records import Exemplar, RetrievedContext

PUT = [{"skill": "grasp", "params": {"object": "red_cube"}}, {"skill": "place", "params": {"destination": "blue_bowl"}}]
HOME = {"skill": "home", "params": {"speed": 0.2}}
HOLD = {"skill": "hold", "params": {"duration": 2.0}}
SENTENCE = "put the red cube in the bowl"


def contract(*actions):
    return {"id": "c-0001", "context": {}, "action_sequence": list(actions)}


def exemplar(name, *actions, rank=1):
    return Exemplar(
        episode_id=name,
        instruction="put the red cube in the bowl, then go home",
        summary="",
        contract=contract(*actions),
        succeeded=True,
        Delta=0.0,
        similarity=0.9,
        weight=0.6,
        score=0.8,
        rank=rank,
    )


def skills(one):
    return [action["skill"] for action in one.contract["action_sequence"]]


def test_a_recalled_final_step_is_not_shown_for_an_instruction_without_it():
    recall = RetrievedContext(exemplars=(exemplar("a", *PUT, HOME), exemplar("b", *PUT, rank=2)))
    shown, withheld = fit_recall(recall, SENTENCE)
    assert [skills(one) for one in shown.exemplars] == [["grasp", "place"], ["grasp", "place"]]
    assert withheld == ("home",)


@pytest.mark.parametrize("instruction", [f"{SENTENCE}, then go home", f"{SENTENCE} and retract the arm"])
def test_a_requested_step_is_shown(instruction):
    recall = RetrievedContext(exemplars=(exemplar("a", *PUT, HOME),))
    assert fit_recall(recall, instruction) == (recall, ())


def test_an_exemplar_with_an_unrequested_step_in_its_middle_is_not_shown():
    recall = RetrievedContext(exemplars=(exemplar("a", HOME, *PUT), exemplar("b", HOME), exemplar("c", *PUT, rank=3)))
    shown, withheld = fit_recall(recall, SENTENCE)
    assert [(one.episode_id, one.rank) for one in shown.exemplars] == [("c", 1)]
    assert withheld == ("home",)


def test_a_plan_that_copies_the_step_is_refused_with_a_hint():
    rejected = reject_recalled_step(contract(*PUT, HOME), ("home",), SENTENCE)
    assert rejected is not None
    assert rejected.pointer == "/action_sequence/2/skill"
    assert "the instruction does not ask for home" in rejected.hint


@pytest.mark.parametrize(
    ("plan", "withheld", "instruction"),
    [
        (contract(*PUT), ("home",), SENTENCE),
        (contract(*PUT, HOME), (), SENTENCE),  # the planner's own idea, not that of a memory
        (contract(*PUT, HOME), ("home",), f"{SENTENCE}, then go home"),
        (contract(*PUT, HOME), ("hold",), SENTENCE),
        (contract(HOME), ("home",), SENTENCE),  # no step to leave out would remain: the senses judge such a plan
    ],
)
def test_other_plans_are_not_refused(plan, withheld, instruction):
    assert reject_recalled_step(plan, withheld, instruction) is None


def test_unrequested_skills_are_in_the_order_of_the_plan():
    assert unrequested_skills(contract(*PUT, HOLD, HOME), SENTENCE) == ("hold", "home")
    assert unrequested_skills(contract(*PUT, HOLD, HOME), "wait, then go home") == ()
    assert unrequested_skills({}, SENTENCE) == ()
