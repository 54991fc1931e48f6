"""Training of the transformer layer on the token vectors of the frozen sentence encoder."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from dualbrain.core.encoder import TokenEncoder
from dualbrain.grounding.instruction.clauses.clause_classifier import HEADS, KINDS
from tools.clause_classifier.sentences import Sentence

ENCODED, WIDTH, INNER = 384, 128, 256
"""Length of a token vector, of a vector in the layer, and of the inner vector of its second part."""
EPOCHS, BATCH, RATE, DECAY, DROPOUT = 15, 32, 1e-3, 0.05, 0.2
NOISE = 0.05
"""Standard deviation of the noise that is added to the token vectors."""
SMOOTHING = 0.05
"""Share of the other answer in the target of a sentence."""
TOKEN_LOSS, KIND_LOSS = 0.5, 0.3
"""Weights of the losses of the words and of the kind, relative to that of the sentence."""


@dataclass(frozen=True, slots=True)
class Example:
    """Token vectors of a sentence, and its targets; -1 where a target is not known."""

    vectors: Tensor
    clause: float
    kind: int
    tokens: Tensor


class Layer(nn.Module):
    """The trainable part of `ClauseClassifier`, with the same names."""

    def __init__(self) -> None:
        super().__init__()
        self.input = nn.Linear(ENCODED, WIDTH)
        self.dropout = nn.Dropout(DROPOUT)
        self.layer = nn.TransformerEncoderLayer(WIDTH, HEADS, INNER, DROPOUT, batch_first=True)
        self.token, self.attention_pool = nn.Linear(WIDTH, 1), nn.Linear(WIDTH, 1)
        self.score, self.kind = nn.Linear(2 * WIDTH, 1), nn.Linear(2 * WIDTH, len(KINDS))

    def forward(self, vectors: Tensor, valid: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Scores (b,), kinds (b, kinds) and marks of the tokens (b, t) of padded vectors (b, t, 384)."""
        hidden = self.layer(self.dropout(self.input(vectors)), src_key_padding_mask=~valid)
        weights = self.attention_pool(hidden)[..., 0].masked_fill(~valid, -1e9).softmax(1)[..., None]
        largest = hidden.masked_fill(~valid[..., None], -1e9).max(1).values
        pooled = torch.cat([(weights * hidden).sum(1), largest], -1)
        return self.score(pooled)[:, 0], self.kind(pooled), self.token(hidden)[..., 0]


def make_examples(sentences: Sequence[Sentence], encoder: TokenEncoder) -> list[Example]:
    """The sentences as the encoder reads them."""
    return [_example(one, *encoder.encode_tokens(one.text)) for one in sentences]


def _example(one: Sentence, vectors: NDArray[np.float32], positions: tuple[tuple[int, int], ...]) -> Example:
    start = one.text.find(one.words) if one.words else -1
    end = start + len(one.words)
    inside = [float(a < end and b > start and b > a) for a, b in positions]
    marks = torch.tensor(inside) if start >= 0 else torch.full((len(positions),), -1.0 if one.clause else 0.0)
    kind = KINDS.index(one.kind) if one.kind in KINDS else -1  # type: ignore[arg-type]
    return Example(torch.tensor(vectors), float(one.clause), kind, marks)


def train(examples: Sequence[Example], seed: int = 0) -> Layer:
    """A layer fitted to the examples."""
    torch.manual_seed(seed)
    generator, layer = np.random.default_rng(seed), Layer()
    optimiser = torch.optim.AdamW(layer.parameters(), RATE, weight_decay=DECAY)
    steps = EPOCHS * -(-len(examples) // BATCH)
    schedule = torch.optim.lr_scheduler.OneCycleLR(optimiser, RATE, total_steps=steps + 1, pct_start=0.1)
    for _ in range(EPOCHS):
        order = generator.permutation(len(examples))
        for batch, vectors, valid in _batches([examples[k] for k in order]):
            noisy = vectors + NOISE * torch.randn_like(vectors)
            optimiser.zero_grad()
            _loss(batch, valid, *layer(noisy, valid)).backward()
            optimiser.step()
            schedule.step()
    return layer.eval()


def scores(layer: Layer, examples: Sequence[Example]) -> NDArray[np.float32]:
    """Logarithms of the odds of a clause (n,)."""
    with torch.no_grad():
        return np.concatenate([layer(vectors, valid)[0].numpy() for _, vectors, valid in _batches(examples)])


def weights_of(layer: Layer) -> dict[str, NDArray[np.float16]]:
    """The weights by the names of `ClauseClassifier`."""
    names = {
        "layer.self_attn.in_proj_": "attention.",
        "layer.self_attn.out_proj": "attention_output",
        "layer.linear1": "inner",
        "layer.linear2": "outer",
        "layer.norm1": "attention_norm",
        "layer.norm2": "inner_norm",
    }
    found = {}
    for torch_name, value in layer.state_dict().items():
        name = torch_name
        for part, own in names.items():
            name = name.replace(part, own)
        found[name] = value.numpy().astype(np.float16)
    return found


def _batches(examples: Sequence[Example]) -> Iterator[tuple[Sequence[Example], Tensor, Tensor]]:
    for start in range(0, len(examples), BATCH):
        batch = examples[start : start + BATCH]
        longest = max(len(one.vectors) for one in batch)
        vectors, valid = torch.zeros(len(batch), longest, ENCODED), torch.zeros(len(batch), longest, dtype=torch.bool)
        for k, one in enumerate(batch):
            vectors[k, : len(one.vectors)], valid[k, : len(one.vectors)] = one.vectors, True
        yield batch, vectors, valid


def _loss(batch: Sequence[Example], valid: Tensor, score: Tensor, kind: Tensor, marks: Tensor) -> Tensor:
    binary = nn.functional.binary_cross_entropy_with_logits
    clause = torch.tensor([one.clause for one in batch])
    kinds = torch.tensor([one.kind for one in batch])
    targets = torch.full(valid.shape, -1.0)
    for k, one in enumerate(batch):
        targets[k, : len(one.tokens)] = one.tokens
    loss = binary(score, clause * (1 - SMOOTHING) + SMOOTHING / 2)
    if (targets >= 0).any():
        loss = loss + TOKEN_LOSS * binary(marks[targets >= 0], targets[targets >= 0])
    if (kinds >= 0).any():
        loss = loss + KIND_LOSS * nn.functional.cross_entropy(kind[kinds >= 0], kinds[kinds >= 0])
    return loss
