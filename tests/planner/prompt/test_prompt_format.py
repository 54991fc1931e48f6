"""How the next answer is drawn where the prompt has no place for what failed."""

import msgspec
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.contracts.verdict import Rejected
from dualbrain.planner.prompt.prompt_format import FULL, SHORT
from dualbrain.records import Setback
from tests.planner.sample_requests import request

REFUSAL = Rejected("envelope", "/action_sequence/0/params/speed", 30.0, "0.05 to 0.4", "lower it")
SETBACK = Setback("run", "failed", (), "grasp red_cube", "slipped")


def test_the_most_probable_answer_is_wanted_until_something_failed():
    assert SHORT.draw(request()) is None
    assert SHORT.draw(request(refusal=REFUSAL)) is not None
    assert FULL.draw(request(refusal=REFUSAL, setback=SETBACK)) is None  # the prompt says it


def test_every_shot_and_every_try_draws_anew():
    failed = [
        request(refusal=REFUSAL), request(refusal=REFUSAL, contract_id="c-0003"), request(setback=SETBACK),
        request(setback=msgspec.structs.replace(SETBACK, episode_id="run.2")),
        request(setback=SETBACK, refusal=REFUSAL),
    ]  # fmt: skip
    assert len({SHORT.draw(one) for one in failed}) == len(failed)


@given(st.text())
def test_the_same_question_draws_alike_and_within_what_engines_take(reason):
    asked = request(setback=msgspec.structs.replace(SETBACK, reason=reason))
    seed = SHORT.draw(asked)
    assert seed == SHORT.draw(asked)
    assert seed is not None
    assert 0 <= seed < 2**31
