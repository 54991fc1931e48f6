"""Hidden states of the starting model at every contract token, computed once so that the KL term is cheap.

With a frozen output matrix, the logits of the base are its final-norm hidden states times that matrix. So d numbers per
token (1 kB for SmolLM2) represent its whole distribution (98 kB) exactly. The entropy of each token is stored as well.
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
"""Number of samples in one forward pass."""


class ReferenceStates:
    """Hidden states (n_i, d) and entropies (n_i,) [nats] of the starting model, by sample id."""

    def __init__(self, rows: dict[str, tuple[Tensor, Tensor]]) -> None:
        """Use states and entropies by sample id."""
        self._rows = rows

    def hidden_states(self, samples: Sequence[EncodedSample]) -> Tensor:
        """The states of `samples`, concatenated in the order of `contract_hidden_states`."""
        return torch.cat([self._rows[one.id][0] for one in samples])

    def entropies(self, samples: Sequence[EncodedSample]) -> list[float]:
        """H_i [nats]: the mean entropy over the tokens of each contract."""
        return [float(self._rows[one.id][1].mean()) for one in samples]


def states_key(base: str, samples: Sequence[EncodedSample], number_format: str) -> str:
    """SHA-256 of all inputs of the states: the hash of the base's weights, every token, the number format."""
    inputs = [base, number_format, [[one.id, one.prompt, one.contract] for one in samples]]
    return hashlib.sha256(repr(inputs).encode()).hexdigest()


@torch.no_grad()
def compute_states(decoder: Any, head: Tensor, samples: Sequence[EncodedSample], padding: int) -> ReferenceStates:
    """The states of `decoder`, which must be the base with its adapter disabled, in evaluation mode."""
    rows: dict[str, tuple[Tensor, Tensor]] = {}
    order = sorted(samples, key=lambda one: len(one.prompt) + len(one.contract))
    for start in range(0, len(order), BATCH_SIZE):
        batch_samples = order[start : start + BATCH_SIZE]
        batch = collate(batch_samples, padding, device=str(head.device))
        hidden, _ = contract_hidden_states(decoder, batch)
        entropies = entropy(log_probabilities(hidden, head))
        parts = zip(
            hidden.split(batch.contract_token_counts), entropies.split(batch.contract_token_counts), strict=True
        )
        for one, (states, nats) in zip(batch_samples, parts, strict=True):
            rows[one.id] = (states.clone(), nats.clone())
    return ReferenceStates(rows)


def save_states(states: ReferenceStates, path: Path, key: str) -> None:
    """Write `states` to `path`, complete or not at all; raises `FileWriteError`."""
    tensors = {
        f"{name}.{what}": t for name, row in states._rows.items() for what, t in zip(("h", "H"), row, strict=True)
    }
    write_atomically(path, encode_tensors(tensors, {"key": key}))


def load_states(path: Path, key: str, device: str = "cpu") -> ReferenceStates | None:
    """The states saved under the same key; None if there are none, they are damaged, or their inputs were others."""
    if not path.is_file():
        return None
    try:
        tensors, facts = read_tensors(path)
    except CorruptFileError:
        return None
    if facts.get("key") != key:
        return None
    on_device = {name: tensor.to(device) for name, tensor in tensors.items()}
    return ReferenceStates(
        {name: (on_device[f"{name}.h"], on_device[f"{name}.H"]) for name in {name[:-2] for name in on_device}}
    )
