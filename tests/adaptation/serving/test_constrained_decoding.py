"""Tokens admitted by a grammar: all tokenisations that a model may use for an admitted text."""

# ruff: noqa: E402  (nothing is imported where the extras are missing)
import json
import os

import pytest

for part in ("torch", "transformers", "llguidance"):
    pytest.importorskip(part, reason="the extra `adapt` is not installed")
from transformers import AutoTokenizer

from dualbrain.adaptation.serving.constrained_decoding import GrammarConstraint, llguidance_tokenizer
from dualbrain.core.weights import default_cache_folder, locate_weights
from dualbrain.planner.decoding.llguidance_grammar import actions_grammar
from dualbrain.planner.registry import SMALL_PLANNER
from tests.planner.sample_requests import plan_request

PLACE = {"skill": "place", "params": {"destination": "blue_bowl", "speed": 0.2, "wait": "none"}}
GRASP = {"skill": "grasp", "params": {"object": "red_cube", "speed": 0.4}}


@pytest.fixture(scope="module")
def tokenizer():
    path = locate_weights(SMALL_PLANNER, default_cache_folder(os.environ))
    return AutoTokenizer.from_pretrained(path.parent, gguf_file=path.name)


@pytest.fixture
def constraint(tokenizer):
    return GrammarConstraint(llguidance_tokenizer(tokenizer), actions_grammar(plan_request().schema))


@pytest.mark.parametrize("sequence", [[PLACE], [GRASP, PLACE], [GRASP, PLACE, GRASP, PLACE], [PLACE, GRASP]])
def test_every_token_of_an_admitted_text_is_admitted(tokenizer, constraint, sequence):
    """Also a token that reaches beyond the forced text: other tokens for the same text are unusual for the model."""
    for token in tokenizer(json.dumps(sequence, separators=(",", ":")) + "}")["input_ids"]:
        assert constraint.allowed_mask(len(tokenizer))[token], tokenizer.decode([token])
        assert constraint.consume(token)
    assert constraint.allowed_mask(len(tokenizer))[tokenizer.eos_token_id]


def test_forced_text_is_drafted(tokenizer, constraint):
    for _ in range(2):
        assert tokenizer.decode(constraint.draft(24, lambda ahead: None)) == '[{"skill":"'
        assert not constraint.consume(tokenizer("x")["input_ids"][0])
