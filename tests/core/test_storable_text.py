"""Untrusted text can always be stored."""

import json

from hypothesis import given
from hypothesis import strategies as st

from dualbrain.core.text import MAX_STORED_CHARACTERS, storable_text

anything = st.text(st.characters(exclude_categories=()))


@given(anything)
def test_stored_text_is_utf_8_and_stable(text):
    kept = storable_text(text)
    assert json.loads(json.dumps(kept).encode("utf-8")) == kept
    kept.encode("utf-8")
    assert storable_text(kept) == kept


@given(st.text())
def test_valid_text_is_unchanged(text):
    assert storable_text(text) == text


def test_surrogates_are_replaced_and_long_text_is_cut_with_its_length():
    assert storable_text("a\ud800b") == "a\ufffdb"
    assert storable_text("x" * 10_000_000).endswith("(10000000 characters)")
    assert len(storable_text("x" * 10_000_000)) < MAX_STORED_CHARACTERS + 40
