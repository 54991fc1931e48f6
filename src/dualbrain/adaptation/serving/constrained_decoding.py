"""Grammar-constrained decoding for transformers with LLGuidance, the grammar engine that llama.cpp uses too."""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import llguidance
import llguidance.hf
import numpy as np
import torch
from torch import Tensor

from dualbrain.errors import ConfigurationError
from dualbrain.planner.decoding.llguidance_grammar import NO_FORCING


class GrammarConstraint:
    """The state of one answer in its grammar, and the tokens that may follow."""

    def __init__(self, vocabulary: Any, grammar: str) -> None:
        """Start at the beginning of `grammar`; raises `ConfigurationError` if LLGuidance cannot parse it."""
        self._matcher = _make_matcher(vocabulary, grammar)
        self._forcing_matcher = _make_matcher(vocabulary, grammar.removeprefix(NO_FORCING))

    def allowed_mask(self, size: int) -> Tensor:
        """Which of `size` tokens may come next, including the end token: (size,) bool."""
        bits = np.frombuffer(self._matcher.compute_bitmask(), np.uint8)
        known = torch.from_numpy(np.unpackbits(bits, bitorder="little")[:size].astype(bool))
        return torch.nn.functional.pad(known, (0, size - len(known)))

    def consume(self, token: int) -> bool:
        """Advance by `token`; False, without a change, if it may not come next."""
        consumed = self._matcher.try_consume_tokens([token]) == 1
        if consumed:
            self._forcing_matcher.try_consume_tokens([token])
        return consumed

    def draft(self, max_tokens: int, guess: Callable[[list[int]], int | None]) -> list[int]:
        """At most `max_tokens` draft tokens: the forced ones where only one text can follow, else those of `guess`.

        The draft ends where the grammar does not admit a guess. The model remains free to choose other tokens for the
        same text.
        """
        ahead: list[int] = []
        trial = self._forcing_matcher.deep_copy()
        while len(ahead) < max_tokens and not trial.is_stopped():
            token = guess(ahead)
            following = trial.compute_ff_tokens() or ([] if token is None else [token])
            n_consumed = trial.try_consume_tokens(following) if following else 0
            ahead += following[:n_consumed]
            if not n_consumed or n_consumed < len(following):
                break
        return ahead[:max_tokens]


def _make_matcher(vocabulary: Any, grammar: str) -> Any:
    matcher = llguidance.LLMatcher(vocabulary, llguidance.grammar_from("lark", grammar))
    if matcher.is_error():
        raise ConfigurationError.stating(f"LLGuidance cannot parse the grammar: {matcher.get_error()}.")
    return matcher


def llguidance_tokenizer(tokenizer: Any) -> Any:
    """The tokenizer in LLGuidance's form."""
    return llguidance.hf.from_tokenizer(tokenizer)
