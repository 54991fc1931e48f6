"""Learned estimate of whether an instruction has a clause that contracts cannot express.

The rules of `clause_search.py` know the wordings that they list. This classifier reads the meaning: a frozen sentence
encoder maps the words to vectors, and one trained transformer layer judges them. It was trained on sentences with and
without a clause (`tools/clause_classifier`), for the skills that are packaged; other skills could express more.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from importlib import import_module, resources
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import NDArray

from dualbrain.contracts.registry import SkillRegistry
from dualbrain.core.encoder import TokenEncoder
from dualbrain.errors import ChecksumError, MissingDependencyError
from dualbrain.grounding.instruction.clauses.rules.clause_rule import ClauseKind
from dualbrain.memory.embedding.text_encoder import MAX_TOKENS, MiniLmEncoder

KINDS: tuple[ClauseKind, ...] = (
    "condition",
    "loop",
    "count",
    "exclusion",
    "relative place",
    "orientation",
    "motion",
    "handing over",
    "alternative",
    "comparison",
    "time",
)
"""The kinds in the order of the classifier's output."""
HEADS = 4
"""Number of attention heads of the layer."""
LAYER_NORM_EPSILON = 1e-5
PACKAGED_SKILLS = frozenset(
    {"move_to", "grasp", "place", "push", "release", "hold", "home", "decline"}
    | {"drive_to", "drive_to_pose", "turn_to", "stop"}
)
"""The skills whose contracts the training sentences assume."""
QUOTE_MARK = -3.0
"""A token whose mark is larger belongs to the words of the clause, if its neighbour does."""
MAX_QUOTE = 200
"""Longest quote of a clause [characters]."""
ENCODER = "minilm-l6-v2-int8@20a8733f"
"""The encoder with whose vectors the classifier was trained."""
WEIGHTS_FILE = "clause_classifier.safetensors"

_Array = NDArray[np.float32]


@dataclass(frozen=True, slots=True)
class ClauseEstimate:
    """`score` is the logarithm of the odds of a clause; `kind` and `quote` describe the most probable one."""

    score: float
    kind: ClauseKind
    quote: str


class ClauseClassifier:
    """A transformer layer on the token vectors of `encoder`.

    With the token vectors x (t, 384), h = W x + b, and the layer LN(h + attention(h)), LN(h + W₂ relu(W₁ h)), the score
    is w·[Σ softmax(v·h) h ; max h] + c. The words of the clause are the tokens around the largest u·h.
    """

    def __init__(self, encoder: TokenEncoder, weights: Mapping[str, _Array]) -> None:
        """The classifier with `weights` (see `tools/clause_classifier`) for the vectors of `encoder`."""
        self._encoder, self._weights = encoder, weights

    @classmethod
    def packaged(cls, encoder: TokenEncoder) -> ClauseClassifier | None:
        """The packaged classifier; None for another encoder than `ENCODER`, with which the rules judge alone.

        Raises `MissingDependencyError` if the package safetensors is missing.
        """
        if encoder.id != ENCODER:
            return None
        try:
            reader: Any = import_module("safetensors.numpy")
        except ImportError as error:
            raise MissingDependencyError(
                "The package safetensors", fix="Install it with `pip install 'dualbrain[memory]'`."
            ) from error
        data = resources.files("dualbrain.grounding.instruction.clauses").joinpath(WEIGHTS_FILE).read_bytes()
        return cls(encoder, {name: value.astype(np.float32) for name, value in reader.load(data).items()})

    def estimate(self, text: str) -> ClauseEstimate:
        """The estimate for an instruction in English.

        A long text is read up to `MAX_TOKENS`; its score is then at least 0, because a clause may be in the rest.
        """
        text = text.encode("utf-8", "replace").decode()
        vectors, positions = self._encoder.encode_tokens(text)
        hidden = self._layer(self._linear("input", vectors))
        attended = _softmax(self._linear("attention_pool", hidden)[:, 0]) @ hidden
        pooled = np.concatenate([attended, hidden.max(axis=0)])
        kind = KINDS[int(self._linear("kind", pooled).argmax())]
        marks = self._linear("token", hidden)[:, 0]
        score = float(self._linear("score", pooled)[0])
        score = max(score, 0.0) if len(positions) >= MAX_TOKENS else score
        return ClauseEstimate(score, kind, _quote(text, marks, positions))

    def _layer(self, hidden: _Array) -> _Array:
        hidden = self._normalise("attention_norm", hidden + self._attend(hidden))
        inner = np.maximum(self._linear("inner", hidden), np.float32(0))
        return self._normalise("inner_norm", hidden + self._linear("outer", inner))

    def _attend(self, hidden: _Array) -> _Array:
        tokens, width = hidden.shape
        query, key, value = (
            part.reshape(tokens, HEADS, -1).swapaxes(0, 1)
            for part in np.split(self._linear("attention", hidden), 3, axis=1)
        )
        shares = _softmax(query @ key.swapaxes(1, 2) / np.sqrt(np.float32(width // HEADS)))
        return self._linear("attention_output", (shares @ value).swapaxes(0, 1).reshape(tokens, width))

    def _linear(self, name: str, x: _Array) -> _Array:
        return x @ self._weights[f"{name}.weight"].T + self._weights[f"{name}.bias"]

    def _normalise(self, name: str, x: _Array) -> _Array:
        centred = x - x.mean(axis=1, keepdims=True)
        spread = np.sqrt(np.square(centred).mean(axis=1, keepdims=True) + np.float32(LAYER_NORM_EPSILON))
        return centred / spread * self._weights[f"{name}.weight"] + self._weights[f"{name}.bias"]


def find_clause_classifier(cache: Path) -> ClauseClassifier | None:
    """The packaged classifier with the encoder in `cache`; None without a usable encoder: the rules judge alone."""
    try:
        return ClauseClassifier.packaged(MiniLmEncoder.from_cache(cache))
    except (MissingDependencyError, ChecksumError):
        return None


def reads_all_skills(registry: SkillRegistry) -> bool:
    """Whether the classifier knows every skill of `registry`: only then does it decline by itself."""
    return PACKAGED_SKILLS.issuperset(registry.by_name)


def _softmax(x: _Array) -> _Array:
    powers = np.exp(x - x.max(axis=-1, keepdims=True))
    return cast(_Array, powers / powers.sum(axis=-1, keepdims=True))


def _quote(text: str, marks: _Array, positions: tuple[tuple[int, int], ...]) -> str:
    """The words around the token with the largest mark, as far as the marks are above `QUOTE_MARK`."""
    words = [k for k, (start, end) in enumerate(positions) if end > start]
    if not words:
        return text[:MAX_QUOTE]
    first = last = max(words, key=lambda k: float(marks[k]))
    while first - 1 in words and marks[first - 1] > QUOTE_MARK:
        first -= 1
    while last + 1 in words and marks[last + 1] > QUOTE_MARK:
        last += 1
    start, end = text.rfind(" ", 0, positions[first][1]) + 1, text.find(" ", positions[last][1])
    quote = text[start : end if end >= 0 else len(text)].strip(" ,.;:!?")
    return (quote or text)[:MAX_QUOTE]
