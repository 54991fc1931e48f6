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

from dualbrain.adaptation.serving.constrained_decoding import Binding

AHEAD = 24
"""Tokens of one answer that are read in a step, at most."""
ALIKE = (8, 3)
"""So many tokens must have been there before, for what followed them to be guessed again; the longer match counts."""


class Reply:
    """One answer under way: the tokens it was `given`, and those it has said since.

    `bound`: what it may say; `guide`: what it will probably say, though free. With a `seed` each token is drawn at
    `temperature`, else the most probable one is taken. `ended`: with the token `end`, or cut after `longest`.
    """

    def __init__(
        self, given: Sequence[int], *, end: int, longest: int, bound: Binding | None = None,
        guide: Binding | None = None, seed: int | None = None, temperature: float = 1.0,
    ) -> None:  # fmt: skip
        """Nothing is said yet."""
        self.given, self.said = list(given), list[int]()
        self._end, self._longest, self._bound, self._guide = end, longest, bound, guide
        self._chance = None if seed is None else torch.Generator().manual_seed(seed)
        self._temperature = temperature
        self._text = list[int]()
        self._followed = dict[tuple[int, ...], int]()
        for token in given:
            self._note(token)

    @property
    def whole(self) -> bool:
        """Whether it came to its own end."""
        return self.said[-1:] == [self._end]

    @property
    def ended(self) -> bool:
        """Whether nothing more is said."""
        return self.whole or len(self.said) >= self._longest

    def following(self) -> list[int]:
        """What is to be read next: the token said last, and a guess of those after it."""
        most = min(AHEAD, self._longest - len(self.said)) - 1
        leading = self._bound or self._guide
        return [self.said[-1], *(leading.foresee(most, self._guess) if leading else [])]

    def hear(self, logits: Tensor, read: Sequence[int]) -> int:
        """Go on by `logits` (t, n), the model's after each of the t tokens that were `read`; how many of them count."""
        for place, row in enumerate(logits):
            token = self._choose(row)
            self._say(token)
            if self.ended or place + 1 == len(read) or read[place + 1] != token:
                return place + 1
        return len(read)

    def _choose(self, logits: Tensor) -> int:
        """The next token; the end where the grammar admits none."""
        if self._bound is not None:
            admitted = self._bound.admitted(len(logits))
            if not admitted.any():
                return self._end
            logits = logits.masked_fill(~admitted, -torch.inf)
        if self._chance is None:
            return int(logits.argmax())
        chances = (logits / self._temperature).softmax(-1)
        return int(torch.multinomial(chances, 1, generator=self._chance))

    def _say(self, token: int) -> None:
        self.said.append(token)
        if token != self._end:
            if self._bound is not None:
                self._bound.take(token)
            if self._guide is not None and not self._guide.take(token):
                self._guide = None
        self._note(token)

    def _note(self, token: int) -> None:
        """Remember what `token` followed; the first time counts, for the best example comes first."""
        for count in ALIKE:
            self._followed.setdefault(tuple(self._text[-count:]), token)
        self._text.append(token)

    def _guess(self, ahead: list[int]) -> int | None:
        """What followed the last words, `ahead` included, when they stood there before."""
        last = [*self._text[-max(ALIKE) :], *ahead]
        found = (self._followed.get(tuple(last[-count:])) for count in ALIKE)
        return next((token for token in found if token is not None), None)


@torch.inference_mode()
def speak(model: Any, replies: Sequence[Reply], late: Callable[[], bool] = lambda: False) -> None:
    """Let all `replies` be said to their ends, side by side, unless it is too `late` for that."""
    live = list(replies)
    memory = _Memory(model)
    for reply, row in zip(live, memory.begin([one.given for one in live]), strict=True):
        reply.hear(row, reply.given[-1:])
    while not late():
        going_on = [place for place, one in enumerate(live) if not one.ended]
        if not going_on:
            return
        if len(going_on) < len(live):
            memory.keep(going_on)
            live = [live[place] for place in going_on]
        read = [one.following() for one in live]
        rows = memory.read(read)
        memory.count([one.hear(row[: len(tokens)], tokens) for one, row, tokens in zip(live, rows, read, strict=True)])


class _Memory:
    """What the model has read: keys and values by (answer, column), and which columns of each answer count."""

    def __init__(self, model: Any) -> None:
        self._model, self._device = model, next(model.parameters()).device
        self._cache: Any = None
        self._columns = self._lengths = torch.zeros(0)

    def begin(self, prompts: list[list[int]]) -> Tensor:
        """Read the prompts, padded on their left; logits (answers, 1, n) after the last tokens, on the processor."""
        width = max(map(len, prompts))
        ids = torch.tensor([[0] * (width - len(one)) + one for one in prompts], device=self._device)
        missing = torch.tensor([[width - len(one)] for one in prompts], device=self._device)
        self._columns = (torch.arange(width, device=self._device) >= missing).long()
        self._lengths = self._columns.sum(1, keepdim=True)
        told = self._model(
            input_ids=ids, attention_mask=self._columns, position_ids=(self._columns.cumsum(1) - 1).clamp(min=0),
            use_cache=True, logits_to_keep=1,
        )  # fmt: skip
        self._cache = told.past_key_values
        return told.logits.float().cpu()

    def read(self, tokens: list[list[int]]) -> Tensor:
        """Read some more of each, padded on the right; logits (answers, t, n) after each token, on the processor."""
        width = max(map(len, tokens))
        ids = torch.tensor([one + [0] * (width - len(one)) for one in tokens], device=self._device)
        lengths = torch.tensor([[len(one)] for one in tokens], device=self._device)
        steps = torch.arange(width, device=self._device)
        self._columns = torch.cat((self._columns, (steps < lengths).long()), 1)
        told = self._model(
            input_ids=ids, attention_mask=self._columns, position_ids=self._lengths + steps,
            past_key_values=self._cache, use_cache=True,
        )  # fmt: skip
        self._width = width
        return told.logits.float().cpu()

    def count(self, good: list[int]) -> None:
        """Of what was read last, only the first so many tokens of each answer count."""
        lengths = torch.tensor(good, device=self._device)[:, None]
        self._columns[:, -self._width :] *= torch.arange(self._width, device=self._device) < lengths
        self._lengths = self._lengths + lengths
        if (waste := self._width - max(good)) > 0:
            self._cache.crop(-waste)
            self._columns = self._columns[:, :-waste]

    def keep(self, answers: list[int]) -> None:
        """Forget all answers but these."""
        chosen = torch.tensor(answers, device=self._device)
        self._cache.batch_select_indices(chosen)
        self._columns, self._lengths = self._columns[chosen], self._lengths[chosen]
