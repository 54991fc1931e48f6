"""The judge of an instruction on ground truth: every fact of the exact episode counts, and a decline by its reason."""

from dataclasses import replace as replace_fields

import numpy as np
import pytest

from dualbrain.grounding.outcome.instruction_truth import judge_decline, make_instruction_judge
from dualbrain.records import Judgement
from dualbrain.robots.loader import load_robot
from dualbrain.simulation.tasks.true_episode import TrueEpisode
from tests.grounding.outcome.tabletop_cases import BEFORE, HOME, evidence, scene_after

PUT = "put the red cube in the bowl"
DONE = TrueEpisode(
    robot_model=load_robot("panda"),
    before=BEFORE,
    after=scene_after({"red_cube": "in the bowl"}),
    q_before=HOME,
    q_after=HOME + 0.3,
    in_hand="",
    touched=frozenset(),
    unsettled=frozenset(),
    broken=frozenset(),
)
JUDGEMENT = Judgement(success=True, progress=1.0, violations=())


def judge(instruction, **facts):
    judged = make_instruction_judge(instruction)
    assert judged is not None
    return judged(replace_fields(DONE, **facts)).success


@pytest.mark.parametrize(
    ("facts", "expected"),
    [
        ({}, True),
        ({"in_hand": "red_cube"}, False),
        ({"touched": frozenset({"red_cube"})}, False),
        ({"unsettled": frozenset({"red_cube"})}, False),
        ({"broken": frozenset({"clear_glass"})}, False),
        ({"after": BEFORE}, False),
        ({"before": scene_after({"green_tin": "far away"})}, False),  # the tin moved meanwhile
    ],
)
def test_every_fact_of_the_exact_episode_counts(facts, expected):
    assert judge(PUT, **facts) is expected


def test_an_object_that_is_in_the_hand_before_and_after_is_held():
    lifted = scene_after({"red_cube": "lifted"})
    held = {"before": lifted, "after": lifted, "in_hand": "red_cube"}
    assert judge("hold the red cube", **held, in_hand_before="red_cube") is True
    assert judge("hold the red cube", **held | {"after": BEFORE}, in_hand_before="red_cube") is False
    home = np.array(load_robot("panda").home)
    assert judge("go home", **held, in_hand_before="red_cube", q_after=home) is True


def test_the_joints_count_for_the_end_of_the_robot():
    still = {"after": BEFORE, "q_after": HOME}
    assert judge("stop", **still) is True
    assert judge("stop", **still | {"q_after": HOME + 0.3}) is False
    assert judge("stop", **still | {"q_before": HOME + 0.3}) is False
    home = np.array(load_robot("panda").home)
    assert judge("go home", after=BEFORE, q_after=home) is True
    assert judge("go home", after=BEFORE, q_after=home + 0.3) is False


def test_words_that_the_parser_does_not_read_are_not_judged():
    assert judge("tidy up a little") is None
    assert make_instruction_judge("  ") is None


@pytest.mark.parametrize(
    ("instruction", "declined", "success", "judged"),
    [
        ("put the banana in the bowl", True, True, True),
        (PUT, True, False, True),
        ("tidy up a little", True, False, False),
    ],
)
def test_a_decline_is_judged_by_its_reason(instruction, declined, success, judged):
    found = judge_decline(JUDGEMENT, instruction, evidence(declined=declined))
    assert found is not None
    assert (found.success, found.judged) == (success, judged)
    assert found.basis.reason.endswith(".")


@pytest.mark.parametrize(
    ("judgement", "words", "declined"), [(None, PUT, True), (JUDGEMENT, PUT, False), (JUDGEMENT, " ", True)]
)
def test_without_a_judgement_words_or_a_decline_nothing_is_judged_again(judgement, words, declined):
    assert judge_decline(judgement, words, evidence(declined=declined)) is judgement
