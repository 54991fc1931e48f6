"""Offline sentence encoder: MiniLM-L6-v2 in int8 through ONNX Runtime."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.encoder import Float32Array
from dualbrain.core.weights import locate_weights
from dualbrain.errors import MissingDependencyError
from dualbrain.memory.embedding.onnx_session import open_session

MAX_TOKENS = 256
"""Longer texts are cut at this length, which is that of the sentence-transformers configuration of the model."""

ENCODER_WEIGHTS, TOKENIZER_WEIGHTS = "minilm-l6-v2-int8", "minilm-l6-v2-tokenizer"
"""Names of the encoder's files in the manifest of weights."""

_FETCH = f"Fetch it with `dualbrain models fetch {ENCODER_WEIGHTS}` and `dualbrain models fetch {TOKENIZER_WEIGHTS}`."
_INSTALL = "Install it with `pip install 'dualbrain[memory]'`."


class MiniLmEncoder:
    """all-MiniLM-L6-v2 (384-d, Apache-2.0), dynamically quantised to int8: the normalised mean of the token vectors.

    Texts are encoded one at a time: dynamic quantisation computes its scales from the whole batch, so that in a batch
    the vector of a text would depend on the other texts.
    """

    dim = 384

    def __init__(self, model: Path, tokenizer: Path) -> None:
        """Load the ONNX file `model` and `tokenizer` (tokenizer.json).

        Raises `MissingDependencyError` if a file or a package is missing.
        """
        for path in (model, tokenizer):
            if not path.is_file():
                raise MissingDependencyError(
                    f"The sentence encoder's file {path.name}", fix=f"{_FETCH} Expected file: {path}"
                )
        digest = hashlib.sha256(model.read_bytes() + tokenizer.read_bytes()).hexdigest()
        self.id = f"minilm-l6-v2-int8@{digest[:8]}"
        self._session = open_session(model.read_bytes())
        self._tokenizer = _tokenizer(tokenizer)

    @classmethod
    def from_cache(cls, cache: Path) -> MiniLmEncoder:
        """The encoder whose files were fetched into `cache`; raises `MissingDependencyError` or `ChecksumError`."""
        return cls(locate_weights(ENCODER_WEIGHTS, cache), locate_weights(TOKENIZER_WEIGHTS, cache))

    def encode(self, texts: Sequence[str]) -> Float32Array:
        """Unit rows of shape (n_texts, 384), float32, for any texts, including empty ones."""
        return np.stack([self._encode_one(text) for text in texts]) if texts else np.empty((0, self.dim), np.float32)

    def encode_tokens(self, text: str) -> tuple[Float32Array, tuple[tuple[int, int], ...]]:
        """Token vectors of shape (tokens, 384), float32, and the positions of the tokens in `text` [characters].

        The tokens that mark the beginning and the end have the position (0, 0). A text is cut at `MAX_TOKENS`.
        """
        encoding = self._tokenizer.encode(text)
        ids = np.asarray([encoding.ids], np.int64)
        inputs = {"input_ids": ids, "attention_mask": np.ones_like(ids), "token_type_ids": np.zeros_like(ids)}
        return np.asarray(self._session.run(None, inputs)[0], np.float32)[0], tuple(encoding.offsets)

    def _encode_one(self, text: str) -> NDArray[np.float32]:
        tokens, _ = self.encode_tokens(text)
        mean = tokens.mean(axis=0, dtype=np.float64)
        return (mean / np.linalg.norm(mean)).astype(np.float32)


def _tokenizer(path: Path) -> Any:
    try:
        tokenizers: Any = import_module("tokenizers")
    except ImportError as error:
        raise MissingDependencyError("The package tokenizers", fix=_INSTALL) from error
    tokenizer = tokenizers.Tokenizer.from_file(str(path))
    tokenizer.no_padding()
    tokenizer.enable_truncation(MAX_TOKENS)
    return tokenizer
