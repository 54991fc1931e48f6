"""Samples as tokens, and several of them as one padded batch."""

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
    """One sample as token ids: the prompt up to where the answer begins, and the contract with its end mark."""

    id: str
    prompt: tuple[int, ...]
    contract: tuple[int, ...]


@dataclass(frozen=True, slots=True)
class Batch:
    """Samples one below the other, padded on the right.

    Token `ids` (b, t), and `targets` (b, t): the token that each place predicts, or `IGNORED` where that is not part of
    a contract.
    """

    ids: Tensor
    targets: Tensor

    @property
    def contract_token_counts(self) -> list[int]:
        """Contract tokens of each sample."""
        return (self.targets != IGNORE_INDEX).sum(1).tolist()


def tokenize_prompt(tokenizer: Any, prompt: Sequence[dict[str, str]]) -> tuple[int, ...]:
    """The tokens of `prompt` by the model's own chat template, with the mark that the assistant speaks next."""
    text = tokenizer.apply_chat_template(list(prompt), add_generation_prompt=True, tokenize=False)
    return tuple(tokenizer(text, add_special_tokens=False)["input_ids"])


def encode_sample(tokenizer: Any, sample: Sample, max_tokens: int) -> EncodedSample:
    """`sample` as tokens; raises `InvalidSetup` if it is longer than the model can read, for nothing is cut off."""
    contract = (*tokenizer(sample.contract, add_special_tokens=False)["input_ids"], tokenizer.eos_token_id)
    encoded = EncodedSample(sample.id, tokenize_prompt(tokenizer, sample.prompt), contract)
    if (length := len(encoded.prompt) + len(contract)) > max_tokens:
        fix = f"Leave memory {sample.memory} out: `dualbrain memory quarantine`."
        raise ConfigurationError(f"tokens of sample {sample.id}", got=length, allowed=f"at most {max_tokens}", fix=fix)
    return encoded


def collate(samples: Sequence[EncodedSample], padding: int, device: str = "cpu") -> Batch:
    """`samples` padded on the right."""
    longest = max(len(one.prompt) + len(one.contract) for one in samples)
    shape = (len(samples), longest)
    ids, targets = torch.full(shape, padding), torch.full(shape, IGNORE_INDEX)
    for row, one in enumerate(samples):
        whole, first = (*one.prompt, *one.contract), len(one.prompt) - 1
        ids[row, : len(whole)] = torch.tensor(whole)
        targets[row, first : first + len(one.contract)] = torch.tensor(one.contract)
    return Batch(ids.to(device), targets.to(device))


def contract_hidden_states(decoder: Any, batch: Batch) -> tuple[Tensor, Tensor]:
    """Final-norm hidden states (n, d) at the places that predict contract tokens, and those tokens (n,), row by row.

    Without a mask, for none is needed: each place looks back only, and padding lies after all that is read. Attention
    then computes half the square.
    """
    hidden = decoder(input_ids=batch.ids, use_cache=False).last_hidden_state
    places = batch.targets != IGNORE_INDEX
    return hidden[places], batch.targets[places]
