"""Episodic memory (paper 5): event ledger, joint embedding, retrieval R and learned weights w."""

from __future__ import annotations

from typing import TYPE_CHECKING

from dualbrain.core.lazy_exports import lazy_exports

if TYPE_CHECKING:
    from dualbrain.memory.config import MemoryConfig
    from dualbrain.memory.embedding.hashing_encoder import HashingEncoder
    from dualbrain.memory.embedding.posture_features import Posture, PostureLimits
    from dualbrain.memory.embedding.text_encoder import MiniLmEncoder
    from dualbrain.memory.ledger.ledger import Ledger, LedgerReader
    from dualbrain.memory.memory import Memory, StoreReport
    from dualbrain.memory.plasticity.hebbian_update import Plasticity

_MODULES = {
    "memory.config": ("MemoryConfig",),
    "memory.embedding.hashing_encoder": ("HashingEncoder",),
    "memory.embedding.posture_features": (
        "Posture",
        "PostureLimits",
    ),
    "memory.embedding.text_encoder": ("MiniLmEncoder",),
    "memory.ledger.ledger": (
        "Ledger",
        "LedgerReader",
    ),
    "memory.memory": (
        "Memory",
        "StoreReport",
    ),
    "memory.plasticity.hebbian_update": ("Plasticity",),
}
"""Public names by the module that defines them."""

__all__ = [
    "HashingEncoder",
    "Ledger",
    "LedgerReader",
    "Memory",
    "MemoryConfig",
    "MiniLmEncoder",
    "Plasticity",
    "Posture",
    "PostureLimits",
    "StoreReport",
]

__getattr__, __dir__ = lazy_exports(__name__, _MODULES)
