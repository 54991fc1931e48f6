"""Given ahead or not, alone or side by side: the same is said."""

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
    "say the same, say the same, say the s",
    "x",
    '{"steps":["open the hand","open the hand"]} again:',
)
LONGEST, HEAT = 56, 0.7


@pytest.fixture(scope="module")
def mind():
    coder = tokenizer()
    return model("llama"), coder, llguidance_tokenizer(coder)


def replies(mind, kind, **told):
    _, coder, vocabulary = mind
    return [
        DecodingStream(
            coder(words, add_special_tokens=False)["input_ids"],
            end_token=256,
            max_tokens=LONGEST,
            **({kind: GrammarConstraint(vocabulary, GRAMMAR)} if kind else {}),
            **told,
        )
        for words in WORDS
    ]


def said(mind, kind, *, together=True, **told):
    mine = replies(mind, kind, **told)
    for group in [mine] if together else [[one] for one in mine]:
        generate(mind[0], group)
    return [one.output_tokens for one in mine]


def token_by_token(mind, one, bound, chance=None):
    """The same from first principles: the whole text is read anew for each token."""
    text, said = list(one.given), []
    while len(said) < LONGEST and said[-1:] != [256]:
        with torch.no_grad():
            logits = mind[0](input_ids=torch.tensor([text + said]), use_cache=False).logits[0, -1]
        if bound:
            logits = logits.masked_fill(~bound.admitted(len(logits)), -torch.inf)
        chances = (logits / HEAT).softmax(-1)
        told = torch.multinomial(chances, 1, generator=chance) if chance else logits.argmax()
        said.append(int(told))
        if bound and said[-1] != 256:
            assert bound.take(said[-1])
    return said


@pytest.mark.parametrize("kind", ["", "guide", "bound"])
@pytest.mark.parametrize("seed", [None, 3])
def test_it_says_what_is_said_token_by_token(mind, kind, seed):
    wanted = [
        token_by_token(
            mind,
            one,
            GrammarConstraint(mind[2], GRAMMAR) if kind == "bound" else None,
            None if seed is None else torch.Generator().manual_seed(seed),
        )
        for one in replies(mind, kind)
    ]
    assert said(mind, kind, seed=seed, temperature=HEAT) == wanted
    assert said(mind, kind, seed=seed, temperature=HEAT, together=False) == wanted


class Guessing(DecodingStream):
    """Guesses three tokens of `truth` each time, or three wrong ones."""

    def __init__(self, one, truth, *, rightly):
        super().__init__(one.given, end_token=256, max_tokens=LONGEST)
        self._truth, self._rightly = truth, rightly

    def following(self):
        guess = self._truth[len(self.output_tokens) : len(self.output_tokens) + 3]
        return [self.output_tokens[-1], *(guess if self._rightly else [(token + 7) % 250 for token in guess])]


def test_what_one_guessed_wrongly_is_forgotten_while_another_goes_on(mind):
    plain = replies(mind, "")
    wanted = [token_by_token(mind, one, None) for one in plain]
    ours = [
        Guessing(one, truth, rightly=place % 2 == 0)
        for place, (one, truth) in enumerate(zip(plain, wanted, strict=True))
    ]
    generate(mind[0], ours)
    assert [one.output_tokens for one in ours] == wanted


def test_what_is_forced_costs_no_step_of_its_own(mind, monkeypatch):
    counted = []
    inner = speculative_decoding._KeyValueCache.extend
    monkeypatch.setattr(
        speculative_decoding._KeyValueCache,
        "extend",
        lambda self, tokens: counted.append(tokens) or inner(self, tokens),
    )
    first = said(mind, "bound")
    steps = len(counted)
    assert all(json.loads(mind[1].decode(one, skip_special_tokens=True))["steps"] for one in first)
    assert 3 * steps < max(map(len, first))
    monkeypatch.setattr(speculative_decoding, "MAX_READ_TOKENS", 1)
    counted.clear()
    assert said(mind, "bound") == first
    assert len(counted) == max(map(len, first)) - 1


def test_what_was_said_before_is_foreseen_and_a_guide_that_is_left_is_let_go(mind):
    def coded(words):
        return mind[1](words, add_special_tokens=False)["input_ids"]

    def wanting(letter):
        row = torch.zeros(1, 258)
        row[0, coded(letter)] = 9.0
        return row

    guide = GrammarConstraint(mind[2], 'start: "abc" /[d-z]+/')
    reply = DecodingStream(coded("abcdefgh, z"), end_token=256, max_tokens=8, guide=guide)
    reply.accept(wanting("a"), reply.prompt_tokens[-1:])
    assert reply.next_tokens() == coded("abcdefg")  # forced as far as "abc", then as before, up to the longest answer
    heard = torch.cat([wanting(letter) for letter in "bcdExyz"])
    assert reply.accept(heard, reply.next_tokens()) == 4
    assert reply.output_tokens == coded("abcdE")
    assert reply.next_tokens() == coded("E")


def test_an_answer_is_cut_at_its_limit_and_all_of_them_when_it_is_late(mind):
    cut = replies(mind, "")
    generate(mind[0], cut)
    assert all(one.is_finished and (one.is_complete or len(one.output_tokens) == LONGEST) for one in cut)
    late = replies(mind, "bound")
    generate(mind[0], late, lambda: True)
    assert not any(one.is_finished for one in late)


def test_a_grammar_that_cannot_be_read_is_refused(mind):
    with pytest.raises(ConfigurationError, match="grammar"):
        GrammarConstraint(mind[2], "start: %nothing")
