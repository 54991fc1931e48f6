"""The model card of an exported adapter: it parses, states hashes and results, and no text can change its form."""

import re

import msgspec
import numpy as np
import pytest
from huggingface_hub import ModelCard
from hypothesis import example, given, settings
from hypothesis import strategies as st
from markdown_it import MarkdownIt

from dualbrain.adaptation.adapters.card import AdapterCard, read_adapter_card
from dualbrain.adaptation.adapters.model_card import HUB_MODELS, NOT_MEASURED, model_card
from dualbrain.adaptation.adapters.packaged import packaged_folder
from dualbrain.adaptation.adapters.promotion import Tolerances, decide_promotion
from dualbrain.adaptation.adapters.registry import RegistryEntry
from dualbrain.core.weights import MANIFEST
from tests.adaptation.adapters.test_promotion import trial_results

LOWER, UPPER = (read_adapter_card(packaged_folder(name)) for name in ("base-135m", "starter-135m"))
WEIGHTS = "e" * 64
TEXTS = st.text() | st.sampled_from(
    ("---\nlicense: mit\n---", "| a |\n# h", "<script>alert(1)</script>", "[x](http://y)", "```\n![i](j)", "a: [b, {c")
)


def decision(n_right, champion_right=30, **changes):
    results = (trial_results(UPPER.id, n_right, **changes), trial_results("", champion_right))
    return decide_promotion(*results, Tolerances(), np.random.default_rng(0), dataset="f" * 64)


def parsed(text):
    """YAML header of a card as a dictionary, and the Markdown below it."""
    return ModelCard(text).data.to_dict(), ModelCard(text).text


def test_the_header_names_base_library_licence_and_results():
    header, _ = parsed(model_card([LOWER, UPPER], WEIGHTS, decision(58)))
    assert header["base_model"] == "HuggingFaceTB/SmolLM2-135M-Instruct"
    assert (header["library_name"], header["license"]) == ("peft", "apache-2.0")
    assert {"dualbrain", "lora"} <= set(header["tags"])
    metrics = {
        metric["name"]: (metric["value"], metric.get("args"))
        for result in header["model-index"][0]["results"]
        for metric in result["metrics"]
    }
    found = decision(58)
    for name, measure in found.measures.items():
        value, arguments = metrics[f"{name} (promotion gate)"]
        assert value == pytest.approx(measure.after)
        assert (arguments.get("gain_low"), arguments.get("gain_high")) == (measure.low, measure.high)
    assert metrics["held-out loss [nats/token]"][0] == UPPER.held_out.loss


def test_the_text_names_every_hash_and_the_adapter_below():
    _, text = parsed(model_card([LOWER, UPPER], WEIGHTS))
    for digest in (UPPER.id, UPPER.dataset, UPPER.prompt, UPPER.registry, LOWER.id, LOWER.dataset, WEIGHTS):
        assert digest in text
    assert MANIFEST[LOWER.base].sha256 in text
    assert NOT_MEASURED in text


def test_results_against_an_adapter_are_stated_with_their_intervals():
    found = decision(25, success=40, perplexity=12.0)
    assert not found.promotes
    _, text = parsed(model_card([LOWER, UPPER], WEIGHTS, found))
    assert "**Not promoted**" in text
    for reason in found.against:
        assert f"- {reason}" in text.replace("\\", "")
    for name, measure in found.measures.items():
        row = next(line for line in text.splitlines() if line.startswith(f"| {name} |"))
        interval = "too few questions" if measure.low is None else f"{measure.low:+.4g} to {measure.high:+.4g}"
        assert interval in row
        assert ("worse" in row) == measure.is_worse
    assert sum(measure.is_worse for measure in found.measures.values()) >= 3


def test_rollbacks_are_stated_with_their_reasons():
    entries = [
        RegistryEntry(kind=kind, adapter=UPPER.id, place=("panda", "b"), time=1.7e9, reason=reason)
        for kind, reason in (("promoted", "12 answers in the shadow"), ("rolled back", "grasps the *wrong* side"))
    ]
    _, text = parsed(model_card([LOWER, UPPER], WEIGHTS, history=entries))
    assert "- 2023-11-14: promoted. 12 answers in the shadow" in text
    assert r"- 2023-11-14: rolled back. grasps the \*wrong\* side" in text


def structure(text):
    """Types and tags of all Markdown tokens, without their text."""
    tokens = MarkdownIt("commonmark").enable("table").parse(text)
    inline = [child.type for token in tokens for child in token.children or () if child.type != "softbreak"]
    return [token.type for token in tokens], {kind for kind in inline if kind != "text"}


@settings(max_examples=40)
@given(TEXTS.filter(bool), TEXTS.filter(bool))
@example("0", " ")
@example("\n", "\t")
@example("0", "-")
@example("1. a", "+ b")
@example("7)", "---")
@example("~~~", "===")
def test_no_text_of_a_card_or_log_changes_the_form(first, second):
    def card(one, other):
        changed: AdapterCard = msgspec.structs.replace(
            UPPER, robot=one, sources={other: 3}, versions={one: other}, precision=other, dataset=one, also={}
        )
        found = msgspec.structs.replace(decision(58), runtime=one, against=(other,))
        entry = RegistryEntry(kind="rolled back", adapter=UPPER.id, place=("", ""), time=0.0, reason=one)
        return model_card([LOWER, changed], WEIGHTS, found, [entry])

    header, text = parsed(card(first, second))
    plain_header, plain_text = parsed(card("a", "b"))
    assert header.keys() == plain_header.keys()
    assert {k: v for k, v in header.items() if k != "model-index"} == {
        k: v for k, v in plain_header.items() if k != "model-index"
    }
    assert structure(text) == structure(plain_text)
    assert "<script" not in re.sub(r"\\<", "", text)


def test_every_language_model_has_a_name_on_the_hub():
    assert set(HUB_MODELS) == {file.name for file in MANIFEST.values() if file.filename.endswith(".gguf")}
