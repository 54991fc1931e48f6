"""What a grammar admits: the text, in whatever tokens a model was taught to write it."""

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
def coder():
    path = locate_weights(SMALL_PLANNER, default_cache_folder(os.environ))
    return AutoTokenizer.from_pretrained(path.parent, gguf_file=path.name)


@pytest.fixture
def binding(coder):
    return GrammarConstraint(llguidance_tokenizer(coder), actions_grammar(plan_request().schema))


@pytest.mark.parametrize("sequence", [[PLACE], [GRASP, PLACE], [GRASP, PLACE, GRASP, PLACE], [PLACE, GRASP]])
def test_every_token_of_a_text_that_follows_it_is_admitted(coder, binding, sequence):
    """Also one that reaches beyond what is certain: the same text in other tokens is not what a model knows."""
    for token in coder(json.dumps(sequence, separators=(",", ":")) + "}")["input_ids"]:
        assert binding.admitted(len(coder))[token], coder.decode([token])
        assert binding.take(token)
    assert binding.admitted(len(coder))[coder.eos_token_id]


def test_what_is_certain_is_foreseen_all_the_same(coder, binding):
    for _ in range(2):
        assert coder.decode(binding.draft(24, lambda ahead: None)) == '[{"skill":"'
        assert not binding.take(coder("x")["input_ids"][0])
