"""Several answers at once in torch, each with the tokens given ahead that are forced or can be foreseen.

A model reads twenty tokens in hardly twice the time of one. So a step reads, of every answer, the token chosen last and
a guess of what follows: what its grammar forces, and what followed the same words before (an answer often repeats what
it was shown). The model's own choice after each of them is known then, and the guess counts as far as it is that choice
(speculative decoding, Leviathan et al. 2023; prompt lookup, Saxena 2023). What is said is therefore what would have
been said token by token, greedily or by chance. What proved wrong stays in the model's memory, masked out.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor

from dualbrain.adaptation.serving.constrained_decoding import GrammarConstraint

MAX_READ_TOKENS = 24
"""Tokens of one answer that are read in a step, at most."""
LOOKUP_LENGTHS = (8, 3)
"""So many tokens must have been there before, for what followed them to be guessed again; the longer match counts."""


class DecodingStream:
    """One answer under way: the tokens it was `given`, and those it has said since.

    `bound`: what it may say; `guide`: what it will probably say, though free. With a `seed` each token is drawn at
    `temperature`, else the most probable one is taken. `ended`: with the token `end`, or cut after `longest`.
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
        """Nothing is said yet."""
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
        """Whether it came to its own end."""
        return self.output_tokens[-1:] == [self._end_token]

    @property
    def is_finished(self) -> bool:
        """Whether nothing more is said."""
        return self.is_complete or len(self.output_tokens) >= self._max_tokens

    def next_tokens(self) -> list[int]:
        """What is to be read next: the token said last, and a guess of those after it."""
        most = min(MAX_READ_TOKENS, self._max_tokens - len(self.output_tokens)) - 1
        leading = self._constraint or self._guide
        return [self.output_tokens[-1], *(leading.draft(most, self._look_up) if leading else [])]

    def accept(self, logits: Tensor, read: Sequence[int]) -> int:
        """Go on by `logits` (t, n), the model's after each of the t tokens that were `read`; how many of them count."""
        for place, row in enumerate(logits):
            token = self._choose_token(row)
            self._append(token)
            if self.is_finished or place + 1 == len(read) or read[place + 1] != token:
                return place + 1
        return len(read)

    def _choose_token(self, logits: Tensor) -> int:
        """The next token; the end where the grammar admits none."""
        if self._constraint is not None:
            admitted = self._constraint.allowed_mask(len(logits))
            if not admitted.any():
                return self._end_token
            logits = logits.masked_fill(~admitted, -torch.inf)
        if self._generator is None:
            return int(logits.argmax())
        chances = (logits / self._temperature).softmax(-1)
        return int(torch.multinomial(chances, 1, generator=self._generator))

    def _append(self, token: int) -> None:
        self.output_tokens.append(token)
        if token != self._end_token:
            if self._constraint is not None:
                self._constraint.consume(token)
            if self._guide is not None and not self._guide.consume(token):
                self._guide = None
        self._index_token(token)

    def _index_token(self, token: int) -> None:
        """Remember what `token` followed; the first time counts, for the best example comes first."""
        for count in LOOKUP_LENGTHS:
            self._followers.setdefault(tuple(self._text[-count:]), token)
        self._text.append(token)

    def _look_up(self, ahead: list[int]) -> int | None:
        """What followed the last words, `ahead` included, when they stood there before."""
        last = [*self._text[-max(LOOKUP_LENGTHS) :], *ahead]
        found = (self._followers.get(tuple(last[-count:])) for count in LOOKUP_LENGTHS)
        return next((token for token in found if token is not None), None)


@torch.inference_mode()
def generate(model: Any, streams: Sequence[DecodingStream], is_late: Callable[[], bool] = lambda: False) -> None:
    """Let all `replies` be said to their ends, side by side, unless it is too `late` for that."""
    live = list(streams)
    memory = _KeyValueCache(model)
    for reply, row in zip(live, memory.prefill([one.prompt_tokens for one in live]), strict=True):
        reply.accept(row, reply.prompt_tokens[-1:])
    while not is_late():
        going_on = [place for place, one in enumerate(live) if not one.is_finished]
        if not going_on:
            return
        if len(going_on) < len(live):
            memory.select(going_on)
            live = [live[place] for place in going_on]
        read = [one.next_tokens() for one in live]
        rows = memory.extend(read)
        memory.accept(
            [one.accept(row[: len(tokens)], tokens) for one, row, tokens in zip(live, rows, read, strict=True)]
        )


class _KeyValueCache:
    """What the model has read: keys and values by (answer, column), and which columns of each answer count."""

    def __init__(self, model: Any) -> None:
        self._model, self._device = model, next(model.parameters()).device
        self._cache: Any = None
        self._mask = self._lengths = torch.zeros(0)

    def prefill(self, prompts: list[list[int]]) -> Tensor:
        """Read the prompts, padded on their left; logits (answers, 1, n) after the last tokens, on the processor."""
        width = max(map(len, prompts))
        ids = torch.tensor([[0] * (width - len(one)) + one for one in prompts], device=self._device)
        missing = torch.tensor([[width - len(one)] for one in prompts], device=self._device)
        self._mask = (torch.arange(width, device=self._device) >= missing).long()
        self._lengths = self._mask.sum(1, keepdim=True)
        told = self._model(
            input_ids=ids,
            attention_mask=self._mask,
            position_ids=(self._mask.cumsum(1) - 1).clamp(min=0),
            use_cache=True,
            logits_to_keep=1,
        )
        self._cache = told.past_key_values
        return told.logits.float().cpu()

    def extend(self, tokens: list[list[int]]) -> Tensor:
        """Read some more of each, padded on the right; logits (answers, t, n) after each token, on the processor."""
        width = max(map(len, tokens))
        ids = torch.tensor([one + [0] * (width - len(one)) for one in tokens], device=self._device)
        lengths = torch.tensor([[len(one)] for one in tokens], device=self._device)
        steps = torch.arange(width, device=self._device)
        self._mask = torch.cat((self._mask, (steps < lengths).long()), 1)
        told = self._model(
            input_ids=ids,
            attention_mask=self._mask,
            position_ids=self._lengths + steps,
            past_key_values=self._cache,
            use_cache=True,
        )
        self._width = width
        return told.logits.float().cpu()

    def accept(self, good: list[int]) -> None:
        """Of what was read last, only the first so many tokens of each answer count."""
        lengths = torch.tensor(good, device=self._device)[:, None]
        self._mask[:, -self._width :] *= torch.arange(self._width, device=self._device) < lengths
        self._lengths = self._lengths + lengths
        if (waste := self._width - max(good)) > 0:
            self._cache.crop(-waste)
            self._mask = self._mask[:, :-waste]

    def select(self, answers: list[int]) -> None:
        """Forget all answers but these."""
        chosen = torch.tensor(answers, device=self._device)
        self._cache.batch_select_indices(chosen)
        self._mask, self._lengths = self._mask[chosen], self._lengths[chosen]
