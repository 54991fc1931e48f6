"""Sentence encoders: unit rows that depend on one text each, meaning (with weights), and errors for missing files."""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.core.encoder import Encoder
from dualbrain.core.weights import default_cache_folder
from dualbrain.errors import MissingDependencyError
from dualbrain.memory.embedding.hashing_encoder import HashingEncoder
from dualbrain.memory.embedding.text_encoder import MiniLmEncoder

AWKWARD = ("", " ", "\x00", "a" * 5000, "红色方块放进碗里", "💥" * 300, "\u202e\u200b", "[MASK] [SEP] [PAD]")


@pytest.fixture(scope="module")
def minilm() -> MiniLmEncoder:
    cache = default_cache_folder(os.environ)
    return MiniLmEncoder.from_cache(cache)


def _check_rows(encoder: Encoder, texts: list[str]) -> None:
    rows = encoder.encode(texts)
    assert (rows.shape, rows.dtype) == ((len(texts), encoder.dim), np.float32)
    assert np.allclose(np.linalg.norm(rows, axis=1), 1.0, atol=1e-5)
    for text, row in zip(texts, rows, strict=True):
        assert np.array_equal(encoder.encode([text])[0], row)


@given(st.lists(st.text(max_size=40), max_size=4))
def test_hashing_gives_unit_rows_that_depend_on_each_text_alone(texts: list[str]) -> None:
    _check_rows(HashingEncoder(32), texts)


def test_hashing_accepts_any_text() -> None:
    _check_rows(HashingEncoder(32), list(AWKWARD))


def test_hashing_compares_shared_words() -> None:
    a, b, c = HashingEncoder(64).encode(["put the red cube away", "put the blue cube away", "swim home"])
    assert a @ b > 0.5 > a @ c


@pytest.mark.parametrize("absent", ["model.onnx", "tokenizer.json"])
def test_a_missing_file_names_the_command_that_fetches_it(tmp_path: Path, absent: str) -> None:
    for name in {"model.onnx", "tokenizer.json"} - {absent}:
        (tmp_path / name).write_bytes(b"")
    with pytest.raises(MissingDependencyError, match=rf"{absent} is missing.*dualbrain models fetch minilm-l6-v2-int8"):
        MiniLmEncoder(tmp_path / "model.onnx", tmp_path / "tokenizer.json")


@pytest.mark.llm
def test_minilm_gives_unit_rows_that_depend_on_each_text_alone(minilm: MiniLmEncoder) -> None:
    _check_rows(minilm, [*AWKWARD, "put the red cube in the bowl"])
    assert minilm.encode([]).shape == (0, 384)


@pytest.mark.llm
def test_minilm_compares_meaning(minilm: MiniLmEncoder) -> None:
    texts = ["pick up the red cube and place it in the bowl", "put the red block into the bowl", "push the mug away"]
    base, same, other = minilm.encode(texts)
    assert base @ same == pytest.approx(0.71, abs=0.03)
    assert base @ other == pytest.approx(0.28, abs=0.03)


@pytest.mark.llm
def test_minilm_is_named_by_its_content(minilm: MiniLmEncoder) -> None:
    assert minilm.id.startswith("minilm-l6-v2-int8@")
    assert len(minilm.id) == len("minilm-l6-v2-int8@") + 8
