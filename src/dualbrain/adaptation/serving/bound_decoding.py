"""The contract's grammar in transformers: LLGuidance, the engine that llama.cpp has built in, as a logits processor."""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import llguidance
import llguidance.hf
import numpy as np
import torch
from torch import Tensor
from transformers import LogitsProcessor, StoppingCriteria

from dualbrain.errors import InvalidSetup


class BoundDecoding(LogitsProcessor):
    """Takes away every token after which no whole answer could follow.

    `start` is the length of what was given: the grammar is about what follows. One answer each.
    """

    def __init__(self, vocabulary: Any, grammar: str, start: int) -> None:
        """Bind an answer to `grammar`; raises `InvalidSetup` for one that LLGuidance cannot read."""
        text = grammar.removeprefix("%llguidance {}\n")
        self._matcher = llguidance.LLMatcher(vocabulary, llguidance.grammar_from("lark", text))
        if self._matcher.is_error():
            raise InvalidSetup("grammar", got=self._matcher.get_error(), allowed="one that LLGuidance reads")
        self._read = start

    def __call__(self, input_ids: Tensor, scores: Tensor) -> Tensor:
        """`scores` (1, n) with minus infinity for what the grammar does not admit after `input_ids` (1, t)."""
        for token in input_ids[0, self._read :].tolist():
            self._matcher.consume_token(token)
        self._read = input_ids.shape[1]
        bits = np.frombuffer(self._matcher.compute_bitmask(), np.uint8)
        admitted = torch.zeros(scores.shape[1], dtype=torch.bool)
        known = torch.from_numpy(np.unpackbits(bits, bitorder="little")[: scores.shape[1]].astype(bool))
        admitted[: len(known)] = known
        return scores.masked_fill(~admitted.to(scores.device), -torch.inf)


class OutOfTime(StoppingCriteria):
    """Ends an answer at a moment of a clock [s]; `late` tells that it did."""

    def __init__(self, until: float, clock: Callable[[], float]) -> None:
        """Let it go on until `until`."""
        self._until, self._clock, self.late = until, clock, False

    def __call__(self, input_ids: Tensor, scores: Any, **told: Any) -> Any:
        """Whether to end now, for each row."""
        del scores, told
        self.late = self._clock() > self._until
        return torch.full((input_ids.shape[0],), self.late, device=input_ids.device)


def vocabulary_of(tokenizer: Any) -> Any:
    """The tokenizer as LLGuidance wants it."""
    return llguidance.hf.from_tokenizer(tokenizer)
