"""Tokenised samples and padded batches."""

# pyright: reportMissingImports=false

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from dualbrain.adaptation.curation.sample import Sample
from dualbrain.errors import ConfigurationError

IGNORE_INDEX = -100


@dataclass(frozen=True, slots=True)
class EncodedSample:
    """One sample as token ids: the prompt up to the start of the answer, and the contract with its end token."""

    id: str
    prompt: tuple[int, ...]
    contract: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Batch:
    """Samples padded on the right.

    `ids` (b, t) are the tokens; `targets` (b, t) are the tokens that each position predicts, `IGNORE_INDEX` outside the
    contracts.
    """

    ids: Tensor
    targets: Tensor

    @property
    def contract_token_counts(self) -> list[int]:
        """Number of contract tokens of each sample."""
        return (self.targets != IGNORE_INDEX).sum(1).tolist()


def tokenize_prompt(tokenizer: Any, prompt: Sequence[dict[str, str]]) -> tuple[int, ...]:
    """The tokens of `prompt` in the model's chat template, with the start of the assistant's turn."""
    text = tokenizer.apply_chat_template(list(prompt), add_generation_prompt=True, tokenize=False)
    return tuple(tokenizer(text, add_special_tokens=False)["input_ids"])


def encode_sample(tokenizer: Any, sample: Sample, max_tokens: int) -> EncodedSample:
    """`sample` as tokens; raises `ConfigurationError` if it is longer than the model's context: it is never cut."""
    contract = (*tokenizer(sample.contract, add_special_tokens=False)["input_ids"], tokenizer.eos_token_id)
    encoded = EncodedSample(sample.id, tokenize_prompt(tokenizer, sample.prompt), contract)
    if (length := len(encoded.prompt) + len(contract)) > max_tokens:
        shorter = "Use a base model with a longer context, or questions with shorter prompts."
        fix = f"Exclude memory {sample.memory} with `dualbrain memory quarantine`." if sample.memory else shorter
        raise ConfigurationError(f"tokens of sample {sample.id}", got=length, allowed=f"at most {max_tokens}", fix=fix)
    return encoded


def collate(samples: Sequence[EncodedSample], padding: int, device: str = "cpu") -> Batch:
    """`samples` as one batch, padded on the right with the token `padding`."""
    longest = max(len(one.prompt) + len(one.contract) for one in samples)
    shape = (len(samples), longest)
    ids, targets = torch.full(shape, padding), torch.full(shape, IGNORE_INDEX)
    for row, one in enumerate(samples):
        tokens, first = (*one.prompt, *one.contract), len(one.prompt) - 1
        ids[row, : len(tokens)] = torch.tensor(tokens)
        targets[row, first : first + len(one.contract)] = torch.tensor(one.contract)
    return Batch(ids.to(device), targets.to(device))


def contract_hidden_states(decoder: Any, batch: Batch) -> tuple[Tensor, Tensor]:
    """Final-norm hidden states (n, d) at the positions that predict contract tokens, and these tokens (n,), row by row.

    No mask is needed: attention is causal, and all padding comes after the tokens that are read. Causal attention then
    computes half of the square.
    """
    hidden = decoder(input_ids=batch.ids, use_cache=False).last_hidden_state
    positions = batch.targets != IGNORE_INDEX
    return hidden[positions], batch.targets[positions]
