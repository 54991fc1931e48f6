"""Batched speculative decoding in torch: each answer drafts tokens that are forced or can be predicted.

A model reads twenty tokens in less than twice the time of one. A decoding step therefore reads, for every answer, the
last chosen token and a draft of the next ones: the tokens that its grammar forces, and the tokens that followed the
same tokens before (answers often repeat parts of the prompt). The model's own choice after each drafted token is then
known, and the draft is accepted as far as it agrees (speculative decoding, Leviathan et al. 2023; prompt lookup, Saxena
2023). The result is the same as token by token, greedy or sampled. Rejected tokens stay in the key-value cache, masked
out.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from dualbrain.adaptation.serving.constrained_decoding import GrammarConstraint

MAX_READ_TOKENS = 24
"""Maximum number of tokens of one answer that a step reads."""
LOOKUP_LENGTHS = (8, 3)
"""Numbers of preceding tokens that must match an earlier place for its continuation to be drafted; the longer one
first."""


class DecodingStream:
    """One answer during decoding: its prompt tokens and its output tokens.

    `constraint` restricts the output; `guide` only predicts it. With a `seed` each token is sampled at `temperature`,
    else the most probable one is chosen. The answer ends with `end_token`, or is cut after `max_tokens`.
    """

    def __init__(
        self,
        prompt_tokens: Sequence[int],
        *,
        end_token: int,
        max_tokens: int,
        constraint: GrammarConstraint | None = None,
        guide: GrammarConstraint | None = None,
        seed: int | None = None,
        temperature: float = 1.0,
    ) -> None:
        """Start without output tokens."""
        self.prompt_tokens, self.output_tokens = list(prompt_tokens), list[int]()
        self._end_token, self._max_tokens, self._constraint, self._guide = end_token, max_tokens, constraint, guide
        self._generator = None if seed is None else torch.Generator().manual_seed(seed)
        self._temperature = temperature
        self._text = list[int]()
        self._followers = dict[tuple[int, ...], int]()
        for token in prompt_tokens:
            self._index_token(token)

    @property
    def is_complete(self) -> bool:
        """Whether it ended with the end token."""
        return self.output_tokens[-1:] == [self._end_token]

    @property
    def is_finished(self) -> bool:
        """Whether no more tokens are decoded."""
        return self.is_complete or len(self.output_tokens) >= self._max_tokens

    def next_tokens(self) -> list[int]:
        """The tokens to read next: the last output token and the draft."""
        max_draft = min(MAX_READ_TOKENS, self._max_tokens - len(self.output_tokens)) - 1
        leading = self._constraint or self._guide
        return [self.output_tokens[-1], *(leading.draft(max_draft, self._look_up) if leading else [])]

    def accept(self, logits: Tensor, read: Sequence[int]) -> int:
        """Continue with `logits` (t, n) after each of the t tokens `read`; returns how many of these are accepted."""
        for position, row in enumerate(logits):
            token = self._choose_token(row)
            self._append(token)
            if self.is_finished or position + 1 == len(read) or read[position + 1] != token:
                return position + 1
        return len(read)

    def _choose_token(self, logits: Tensor) -> int:
        """The next token; the end token if the grammar admits none."""
        if self._constraint is not None:
            admitted = self._constraint.allowed_mask(len(logits))
            if not admitted.any():
                return self._end_token
            logits = logits.masked_fill(~admitted, -torch.inf)
        if self._generator is None:
            return int(logits.argmax())
        probabilities = (logits / self._temperature).softmax(-1)
        return int(torch.multinomial(probabilities, 1, generator=self._generator))

    def _append(self, token: int) -> None:
        self.output_tokens.append(token)
        if token != self._end_token:
            if self._constraint is not None:
                self._constraint.consume(token)
            if self._guide is not None and not self._guide.consume(token):
                self._guide = None
        self._index_token(token)

    def _index_token(self, token: int) -> None:
        """Record which tokens `token` followed; the first occurrence is kept, because the best exemplar comes first."""
        for count in LOOKUP_LENGTHS:
            self._followers.setdefault(tuple(self._text[-count:]), token)
        self._text.append(token)

    def _look_up(self, ahead: list[int]) -> int | None:
        """The token that followed the last tokens, `ahead` included, at their first occurrence; None without one."""
        last = [*self._text[-max(LOOKUP_LENGTHS) :], *ahead]
        found = (self._followers.get(tuple(last[-count:])) for count in LOOKUP_LENGTHS)
        return next((token for token in found if token is not None), None)


@torch.inference_mode()
def generate(model: Any, streams: Sequence[DecodingStream], is_late: Callable[[], bool] = lambda: False) -> None:
    """Decode all `streams` side by side to their ends, unless `is_late` returns True before."""
    live = list(streams)
    cache = _KeyValueCache(model)
    for stream, logits in zip(live, cache.prefill([one.prompt_tokens for one in live]), strict=True):
        stream.accept(logits, stream.prompt_tokens[-1:])
    while not is_late():
        going_on = [row for row, one in enumerate(live) if not one.is_finished]
        if not going_on:
            return
        if len(going_on) < len(live):
            cache.select(going_on)
            live = [live[row] for row in going_on]
        read = [one.next_tokens() for one in live]
        rows = cache.extend(read)
        cache.accept(
            [one.accept(row[: len(tokens)], tokens) for one, row, tokens in zip(live, rows, read, strict=True)]
        )


class _KeyValueCache:
    """Keys and values of the tokens read so far, by (answer, column), and the valid columns of each answer."""

    def __init__(self, model: Any) -> None:
        self._model, self._device = model, next(model.parameters()).device
        self._cache: Any = None
        self._mask = self._lengths = torch.zeros(0)

    def prefill(self, prompts: list[list[int]]) -> Tensor:
        """Read the prompts, padded on the left.

        Returns logits (answers, 1, n) after the last tokens, on the CPU.
        """
        width = max(map(len, prompts))
        ids = torch.tensor([[0] * (width - len(one)) + one for one in prompts], device=self._device)
        missing = torch.tensor([[width - len(one)] for one in prompts], device=self._device)
        self._mask = (torch.arange(width, device=self._device) >= missing).long()
        self._lengths = self._mask.sum(1, keepdim=True)
        output = self._model(
            input_ids=ids,
            attention_mask=self._mask,
            position_ids=(self._mask.cumsum(1) - 1).clamp(min=0),
            use_cache=True,
            logits_to_keep=1,
        )
        self._cache = output.past_key_values
        return output.logits.float().cpu()

    def extend(self, tokens: list[list[int]]) -> Tensor:
        """Read further tokens of each answer, padded on the right.

        Returns logits (answers, t, n) after each token, on the CPU.
        """
        width = max(map(len, tokens))
        ids = torch.tensor([one + [0] * (width - len(one)) for one in tokens], device=self._device)
        lengths = torch.tensor([[len(one)] for one in tokens], device=self._device)
        steps = torch.arange(width, device=self._device)
        self._mask = torch.cat((self._mask, (steps < lengths).long()), 1)
        output = self._model(
            input_ids=ids,
            attention_mask=self._mask,
            position_ids=self._lengths + steps,
            past_key_values=self._cache,
            use_cache=True,
        )
        self._width = width
        return output.logits.float().cpu()

    def accept(self, accepted: list[int]) -> None:
        """Keep only the first `accepted` tokens of each answer from the last call of `extend`."""
        lengths = torch.tensor(accepted, device=self._device)[:, None]
        self._mask[:, -self._width :] *= torch.arange(self._width, device=self._device) < lengths
        self._lengths = self._lengths + lengths
        if (n_rejected := self._width - max(accepted)) > 0:
            self._cache.crop(-n_rejected)
            self._mask = self._mask[:, :-n_rejected]

    def select(self, answers: list[int]) -> None:
        """Keep only the answers with these indices."""
        chosen = torch.tensor(answers, device=self._device)
        self._cache.batch_select_indices(chosen)
        self._mask, self._lengths = self._mask[chosen], self._lengths[chosen]
