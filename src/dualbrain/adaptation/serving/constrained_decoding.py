"""The contract's grammar in transformers: LLGuidance, the engine that llama.cpp has built in."""

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
    """Where one answer stands in its grammar, and what may follow there."""

    def __init__(self, vocabulary: Any, grammar: str) -> None:
        """At the beginning of `grammar`; raises `InvalidSetup` for one that LLGuidance cannot read."""
        self._matcher = _make_matcher(vocabulary, grammar)
        self._forcing_matcher = _make_matcher(vocabulary, grammar.removeprefix(NO_FORCING))

    def allowed_mask(self, size: int) -> Tensor:
        """Which of `size` tokens may come next, the end among them: (size,) of bool."""
        bits = np.frombuffer(self._matcher.compute_bitmask(), np.uint8)
        known = torch.from_numpy(np.unpackbits(bits, bitorder="little")[:size].astype(bool))
        return torch.nn.functional.pad(known, (0, size - len(known)))

    def consume(self, token: int) -> bool:
        """Go on by `token`; False, and nothing changes, if it may not come next."""
        taken = self._matcher.try_consume_tokens([token]) == 1
        if taken:
            self._forcing_matcher.try_consume_tokens([token])
        return taken

    def draft(self, max_tokens: int, guess: Callable[[list[int]], int | None]) -> list[int]:
        """At most `most` tokens to come: where only one text can follow, that, and elsewhere what `guess` says.

        As far as the grammar admits it. In which tokens the model says that text is for the model to choose.
        """
        ahead: list[int] = []
        trial = self._forcing_matcher.deep_copy()
        while len(ahead) < max_tokens and not trial.is_stopped():
            token = guess(ahead)
            following = trial.compute_ff_tokens() or ([] if token is None else [token])
            taken = trial.try_consume_tokens(following) if following else 0
            ahead += following[:taken]
            if not taken or taken < len(following):
                break
        return ahead[:max_tokens]


def _make_matcher(vocabulary: Any, grammar: str) -> Any:
    matcher = llguidance.LLMatcher(vocabulary, llguidance.grammar_from("lark", grammar))
    if matcher.is_error():
        raise ConfigurationError("grammar", got=matcher.get_error(), allowed="one that LLGuidance reads")
    return matcher


def llguidance_tokenizer(tokenizer: Any) -> Any:
    """The tokenizer as LLGuidance wants it."""
    return llguidance.hf.from_tokenizer(tokenizer)
