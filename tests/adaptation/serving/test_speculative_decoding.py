"""Speculative decoding gives the same answers with and without drafts, alone and in a batch."""

# ruff: noqa: E402  (nothing is imported where the extras are missing)
import json

import pytest

for part in ("torch", "transformers", "llguidance"):
    pytest.importorskip(part, reason="the extra `adapt` is not installed")
import torch

from dualbrain.adaptation.serving import speculative_decoding
from dualbrain.adaptation.serving.constrained_decoding import GrammarConstraint, llguidance_tokenizer
from dualbrain.adaptation.serving.speculative_decoding import DecodingStream, generate
from dualbrain.errors import ConfigurationError
from dualbrain.planner.decoding.llguidance_grammar import contract_grammar
from tests.adaptation.tiny_gguf import model
from tests.adaptation.tiny_model import tokenizer

pytestmark = pytest.mark.filterwarnings("ignore::FutureWarning", "ignore::UserWarning")
STEPS = {"type": "array", "items": {"enum": ["open the hand", "close the hand"]}, "minItems": 1, "maxItems": 2}
GRAMMAR = contract_grammar(
    {"type": "object", "properties": {"steps": STEPS}, "required": ["steps"], "additionalProperties": False}
)
WORDS = (
    "open, close, open",
    "do the same, do the same, do the s",
    "x",
    '{"steps":["open the hand","open the hand"]} again:',
)
MAX_TOKENS, TEMPERATURE = 56, 0.7


@pytest.fixture(scope="module")
def loaded():
    tiny_tokenizer = tokenizer()
    return model("llama"), tiny_tokenizer, llguidance_tokenizer(tiny_tokenizer)


def make_streams(loaded, kind, **options):
    _, tiny_tokenizer, vocabulary = loaded
    return [
        DecodingStream(
            tiny_tokenizer(words, add_special_tokens=False)["input_ids"],
            end_token=256,
            max_tokens=MAX_TOKENS,
            **({kind: GrammarConstraint(vocabulary, GRAMMAR)} if kind else {}),
            **options,
        )
        for words in WORDS
    ]


def decode(loaded, kind, *, batched=True, **options):
    streams = make_streams(loaded, kind, **options)
    for group in [streams] if batched else [[one] for one in streams]:
        generate(loaded[0], group)
    return [one.output_tokens for one in streams]


def token_by_token(loaded, one, constraint, generator=None):
    """The reference: the whole text is read again for each token."""
    text, output = list(one.prompt_tokens), []
    while len(output) < MAX_TOKENS and output[-1:] != [256]:
        with torch.no_grad():
            logits = loaded[0](input_ids=torch.tensor([text + output]), use_cache=False).logits[0, -1]
        if constraint:
            logits = logits.masked_fill(~constraint.allowed_mask(len(logits)), -torch.inf)
        probabilities = (logits / TEMPERATURE).softmax(-1)
        token = torch.multinomial(probabilities, 1, generator=generator) if generator else logits.argmax()
        output.append(int(token))
        if constraint and output[-1] != 256:
            assert constraint.consume(output[-1])
    return output


@pytest.mark.parametrize("kind", ["", "guide", "constraint"])
@pytest.mark.parametrize("seed", [None, 3])
def test_the_answer_equals_decoding_token_by_token(loaded, kind, seed):
    expected = [
        token_by_token(
            loaded,
            one,
            GrammarConstraint(loaded[2], GRAMMAR) if kind == "constraint" else None,
            None if seed is None else torch.Generator().manual_seed(seed),
        )
        for one in make_streams(loaded, kind)
    ]
    assert decode(loaded, kind, seed=seed, temperature=TEMPERATURE) == expected
    assert decode(loaded, kind, seed=seed, temperature=TEMPERATURE, batched=False) == expected


class Guessing(DecodingStream):
    """Drafts three tokens of `truth` in each step, or three wrong ones."""

    def __init__(self, one, truth, *, is_right):
        super().__init__(one.prompt_tokens, end_token=256, max_tokens=MAX_TOKENS)
        self._truth, self._is_right = truth, is_right

    def next_tokens(self):
        guess = self._truth[len(self.output_tokens) : len(self.output_tokens) + 3]
        return [self.output_tokens[-1], *(guess if self._is_right else [(token + 7) % 250 for token in guess])]


def test_rejected_drafts_of_one_answer_do_not_affect_another(loaded):
    plain = make_streams(loaded, "")
    expected = [token_by_token(loaded, one, None) for one in plain]
    ours = [
        Guessing(one, truth, is_right=place % 2 == 0)
        for place, (one, truth) in enumerate(zip(plain, expected, strict=True))
    ]
    generate(loaded[0], ours)
    assert [one.output_tokens for one in ours] == expected


def test_forced_tokens_need_no_steps_of_their_own(loaded, monkeypatch):
    counted = []
    inner = speculative_decoding._KeyValueCache.extend
    monkeypatch.setattr(
        speculative_decoding._KeyValueCache,
        "extend",
        lambda self, tokens: counted.append(tokens) or inner(self, tokens),
    )
    first = decode(loaded, "constraint")
    steps = len(counted)
    assert all(json.loads(loaded[1].decode(one, skip_special_tokens=True))["steps"] for one in first)
    assert 3 * steps < max(map(len, first))
    monkeypatch.setattr(speculative_decoding, "MAX_READ_TOKENS", 1)
    counted.clear()
    assert decode(loaded, "constraint") == first
    assert len(counted) == max(map(len, first)) - 1


def test_repeated_text_is_drafted_and_a_contradicted_guide_is_dropped(loaded):
    def encode(words):
        return loaded[1](words, add_special_tokens=False)["input_ids"]

    def logits_for(letter):
        row = torch.zeros(1, 258)
        row[0, encode(letter)] = 9.0
        return row

    guide = GrammarConstraint(loaded[2], 'start: "abc" /[d-z]+/')
    stream = DecodingStream(encode("abcdefgh, z"), end_token=256, max_tokens=8, guide=guide)
    stream.accept(logits_for("a"), stream.prompt_tokens[-1:])
    assert stream.next_tokens() == encode("abcdefg")  # "abc" is forced, the rest is as before, up to `max_tokens`
    logits = torch.cat([logits_for(letter) for letter in "bcdExyz"])
    assert stream.accept(logits, stream.next_tokens()) == 4
    assert stream.output_tokens == encode("abcdE")
    assert stream.next_tokens() == encode("E")


def test_an_answer_is_cut_at_its_limit_and_all_answers_at_the_deadline(loaded):
    cut = make_streams(loaded, "")
    generate(loaded[0], cut)
    assert all(one.is_finished and (one.is_complete or len(one.output_tokens) == MAX_TOKENS) for one in cut)
    late = make_streams(loaded, "constraint")
    generate(loaded[0], late, lambda: True)
    assert not any(one.is_finished for one in late)


def test_an_invalid_grammar_is_rejected(loaded):
    with pytest.raises(ConfigurationError, match="grammar"):
        GrammarConstraint(loaded[2], "start: %nothing")
