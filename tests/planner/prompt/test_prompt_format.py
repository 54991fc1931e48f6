"""How the next answer is drawn where the prompt has no place for what failed."""

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.contracts.verdict import Rejected
from dualbrain.planner.prompt.prompt_format import FULL_PROMPT, SHORT_PROMPT
from dualbrain.records import FailureFeedback
from tests.planner.sample_requests import plan_request

REFUSAL = Rejected(
    stage="envelope", pointer="/action_sequence/0/params/speed", got=30.0, allowed="0.05 to 0.4", hint="lower it"
)
SETBACK = FailureFeedback(episode_id="run", outcome="failed", done=(), undone="grasp red_cube", reason="slipped")


def test_the_most_probable_answer_is_wanted_until_something_failed():
    assert SHORT_PROMPT.sampling_seed(plan_request()) is None
    assert SHORT_PROMPT.sampling_seed(plan_request(refusal=REFUSAL)) is not None
    assert FULL_PROMPT.sampling_seed(plan_request(refusal=REFUSAL, setback=SETBACK)) is None  # the prompt says it


def test_every_shot_and_every_try_draws_anew():
    failed = [
        plan_request(refusal=REFUSAL),
        plan_request(refusal=REFUSAL, contract_id="c-0003"),
        plan_request(setback=SETBACK),
        plan_request(setback=msgspec.structs.replace(SETBACK, episode_id="run.2")),
        plan_request(setback=SETBACK, refusal=REFUSAL),
    ]
    assert len({SHORT_PROMPT.sampling_seed(one) for one in failed}) == len(failed)


@given(st.text())
def test_the_same_question_draws_alike_and_within_what_engines_take(reason):
    asked = plan_request(setback=msgspec.structs.replace(SETBACK, reason=reason))
    seed = SHORT_PROMPT.sampling_seed(asked)
    assert seed == SHORT_PROMPT.sampling_seed(asked)
    assert seed is not None
    assert 0 <= seed < 2**31
