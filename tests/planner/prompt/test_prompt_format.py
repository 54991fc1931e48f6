"""Sampling of the next answer if the prompt cannot describe the failure."""

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.contracts.verdict import Rejected
from dualbrain.planner.prompt.prompt_format import FULL_PROMPT, SHORT_PROMPT
from dualbrain.records import FailureFeedback
from tests.planner.sample_requests import plan_request

REJECTION = Rejected(
    stage="envelope", pointer="/action_sequence/0/params/speed", got=30.0, allowed="0.05 to 0.4", hint="lower it"
)
FEEDBACK = FailureFeedback(
    episode_id="run", outcome="failed", done=(), failed_action="grasp red_cube", reason="slipped"
)


def test_the_most_probable_answer_is_used_until_a_failure():
    assert SHORT_PROMPT.sampling_seed(plan_request()) is None
    assert SHORT_PROMPT.sampling_seed(plan_request(rejection=REJECTION)) is not None
    assert (
        FULL_PROMPT.sampling_seed(plan_request(rejection=REJECTION, failure_feedback=FEEDBACK)) is None
    )  # the prompt describes the failure


def test_every_attempt_is_sampled_with_another_seed():
    failed = [
        plan_request(rejection=REJECTION),
        plan_request(rejection=REJECTION, contract_id="c-0003"),
        plan_request(failure_feedback=FEEDBACK),
        plan_request(failure_feedback=msgspec.structs.replace(FEEDBACK, episode_id="run.2")),
        plan_request(failure_feedback=FEEDBACK, rejection=REJECTION),
    ]
    assert len({SHORT_PROMPT.sampling_seed(one) for one in failed}) == len(failed)


@given(st.text())
def test_the_seed_of_a_request_is_reproducible_and_valid_for_all_engines(reason):
    request = plan_request(failure_feedback=msgspec.structs.replace(FEEDBACK, reason=reason))
    seed = SHORT_PROMPT.sampling_seed(request)
    assert seed == SHORT_PROMPT.sampling_seed(request)
    assert seed is not None
    assert 0 <= seed < 2**31
