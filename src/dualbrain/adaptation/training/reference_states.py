"""What the starting model thinks at every contract token: kept once, so that the KL term costs no second forward pass.

With the output matrix frozen, the base's logits are its final-norm hidden states times that matrix. So d numbers a
token (1 kB for SmolLM2) stand for its whole distribution (98 kB), exactly. Beside them stands its entropy.
"""

# pyright: reportMissingImports=false

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from dualbrain.adaptation.training.checksummed_tensors import CorruptFileError, encode_tensors, read_tensors
from dualbrain.adaptation.training.model.batching import EncodedSample, collate, contract_hidden_states
from dualbrain.adaptation.training.objective import entropy, log_probabilities
from dualbrain.core.storage.atomic_files import write_atomically

BATCH_SIZE = 8
"""Samples in one pass."""


class ReferenceStates:
    """Hidden states (n_i, d) and entropies (n_i,) [nats] of the starting model, by sample id."""

    def __init__(self, rows: dict[str, tuple[Tensor, Tensor]]) -> None:
        """Take states and entropies by id."""
        self._rows = rows

    def hidden_states(self, samples: Sequence[EncodedSample]) -> Tensor:
        """The states of `samples`, one below the other, as `contract_states` orders them."""
        return torch.cat([self._rows[one.id][0] for one in samples])

    def entropies(self, samples: Sequence[EncodedSample]) -> list[float]:
        """H_i [nats]: the mean entropy over the tokens of each contract."""
        return [float(self._rows[one.id][1].mean()) for one in samples]


def states_key(base: str, samples: Sequence[EncodedSample], numbers: str) -> str:
    """SHA-256 of all that the states depend on: the base's weights (by hash), every token, the number format."""
    told = [base, numbers, [[one.id, one.prompt, one.contract] for one in samples]]
    return hashlib.sha256(repr(told).encode()).hexdigest()


@torch.no_grad()
def compute_states(decoder: Any, head: Tensor, samples: Sequence[EncodedSample], padding: int) -> ReferenceStates:
    """The states of `decoder`, which must be the base (adapter off), in evaluation mode."""
    rows: dict[str, tuple[Tensor, Tensor]] = {}
    order = sorted(samples, key=lambda one: len(one.prompt) + len(one.contract))
    for start in range(0, len(order), BATCH_SIZE):
        some = order[start : start + BATCH_SIZE]
        batch = collate(some, padding, device=str(head.device))
        hidden, _ = contract_hidden_states(decoder, batch)
        spread = entropy(log_probabilities(hidden, head))
        parts = zip(hidden.split(batch.contract_token_counts), spread.split(batch.contract_token_counts), strict=True)
        for one, (states, nats) in zip(some, parts, strict=True):
            rows[one.id] = (states.clone(), nats.clone())
    return ReferenceStates(rows)


def save_states(states: ReferenceStates, path: Path, key: str) -> None:
    """Write `states` to `path`, whole or not at all."""
    tensors = {
        f"{name}.{what}": t for name, row in states._rows.items() for what, t in zip(("h", "H"), row, strict=True)
    }
    write_atomically(path, encode_tensors(tensors, {"key": key}))


def load_states(path: Path, key: str, device: str = "cpu") -> ReferenceStates | None:
    """What `keep` wrote under the same key; None if there is nothing, it is damaged, or was made of something else."""
    if not path.is_file():
        return None
    try:
        tensors, facts = read_tensors(path)
    except CorruptFileError:
        return None
    if facts.get("key") != key:
        return None
    there = {name: tensor.to(device) for name, tensor in tensors.items()}
    return ReferenceStates({name: (there[f"{name}.h"], there[f"{name}.H"]) for name in {name[:-2] for name in there}})
