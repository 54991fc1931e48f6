"""Jump-forward decoding: the answer of the model, in its own tokens, with fewer questions to it."""

import json
import re
from collections.abc import Sequence
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.contracts.schema import decoding_schema
from dualbrain.planner.decoding.jump_forward import JumpForwardDecoder, JumpForwardError, TokenCandidate
from dualbrain.planner.decoding.llguidance_grammar import actions_grammar
from tests.planner.sample_requests import NAMES, REGISTRY

GRAMMAR = actions_grammar(decoding_schema(REGISTRY, NAMES))
SPEEDS = st.sampled_from([0.05, 0.1, 0.15, 0.2, 0.29, 0.3, 0.4])
GRASPS = st.fixed_dictionaries({"object": st.sampled_from(NAMES.graspable), "speed": SPEEDS})
PLACES = st.fixed_dictionaries(
    {"destination": st.sampled_from(NAMES.receptive), "speed": SPEEDS, "wait": st.sampled_from(["none", "clear"])}
)
REASONS = st.fixed_dictionaries({"reason": st.text("abc d,.é:", min_size=1, max_size=20)})
ACTIONS = st.one_of(
    st.fixed_dictionaries({"skill": st.just("grasp"), "params": GRASPS}),
    st.fixed_dictionaries({"skill": st.just("place"), "params": PLACES}),
    st.fixed_dictionaries({"skill": st.just("decline"), "params": REASONS}),
)


def tokenize(text: str) -> list[tuple[int, bytes]]:
    """Words, single digits, and runs of other characters, as the tokenizers of the packaged models divide contracts."""
    pieces = re.findall(r"[^\W\d_]+|\d|[^\w]+|_", text)
    return [(int.from_bytes(piece.encode()[:7]) * 31 + len(piece), piece.encode()) for piece in pieces]


class Writer:
    """A model that wants to write one text in its own tokens, and counts the questions to it."""

    def __init__(self, text: str) -> None:
        self.tokens, self.asked = tokenize(text), 0

    def candidates(self, answer: Sequence[int]) -> list[TokenCandidate]:
        self.asked += 1
        assert list(answer) == [token for token, _ in self.tokens[: len(answer)]]  # nothing else is ever read
        wanted = TokenCandidate(*self.tokens[len(answer)])
        return [TokenCandidate(0, b""), TokenCandidate(1, b"\x00"), wanted]


def decoder(writer: Any, **changed: Any) -> JumpForwardDecoder:
    fields = {"grammar": GRAMMAR, "tokenize": tokenize, "candidates": writer.candidates, "max_tokens": 999}
    return JumpForwardDecoder(**(fields | changed))


def as_text(actions: list[dict[str, Any]]) -> str:
    """The end of a contract with `actions`, keys in the order of the registry."""
    orders = {skill.name: [parameter.name for parameter in skill.parameters] for skill in REGISTRY.skills}
    ordered = [
        {"skill": one["skill"], "params": {name: one["params"][name] for name in orders[one["skill"]]}}
        for one in actions
    ]
    return json.dumps(ordered, separators=(",", ":"), ensure_ascii=False) + "}"


@settings(max_examples=60)
@given(st.lists(ACTIONS, min_size=1, max_size=4))
def test_the_answer_is_what_the_model_writes_in_its_own_tokens(actions: list[dict[str, Any]]) -> None:
    writer = Writer(as_text(actions))
    decoding = decoder(writer)
    assert decoding.decode() == as_text(actions)
    assert decoding.tokens == [token for token, _ in writer.tokens]
    assert decoding.is_complete


def test_most_tokens_of_a_contract_are_never_asked_for() -> None:
    grasp = {"skill": "grasp", "params": {"object": "red_cube", "speed": 0.2}}
    place = {"skill": "place", "params": {"destination": "blue_bowl", "speed": 0.2, "wait": "none"}}
    writer = Writer(as_text([grasp, place]))
    decoding = decoder(writer)
    decoding.decode()
    assert writer.asked == decoding.n_steps < 0.5 * len(decoding.tokens)


def test_the_text_is_shown_while_it_grows() -> None:
    shown: list[str] = []
    text = as_text([{"skill": "grasp", "params": {"object": "red_cube", "speed": 0.2}}])
    decoder(Writer(text), show=shown.append).decode()
    assert shown[-1] == text
    assert all(text.startswith(one) for one in shown)
    assert any('"grasp"' in one and "red_cube" not in one for one in shown)


def test_an_answer_ends_at_the_token_limit() -> None:
    decoding = decoder(
        Writer(as_text([{"skill": "grasp", "params": {"object": "red_cube", "speed": 0.2}}])), max_tokens=8
    )
    text = decoding.decode()
    assert not decoding.is_complete
    assert text.startswith('[{"skill":"grasp"')
    assert "speed" not in text


@pytest.mark.parametrize("candidates", [[], [TokenCandidate(7, b"hello")], [TokenCandidate(7, b"")]])
def test_a_model_that_offers_nothing_admitted_gives_no_answer(candidates: list[TokenCandidate]) -> None:
    with pytest.raises(JumpForwardError):
        decoder(Writer(""), candidates=lambda answer: candidates).decode()


def test_a_grammar_that_cannot_be_parsed_gives_no_answer() -> None:
    with pytest.raises(JumpForwardError):
        decoder(Writer(""), grammar="start: nothing_known").decode()
