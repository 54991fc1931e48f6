"""All dials of memory in one place."""

from __future__ import annotations

from dataclasses import dataclass, field

from dualbrain.memory.embedding.joint_embedding import EmbeddingConfig
from dualbrain.memory.embedding.posture_features import PostureLimits
from dualbrain.memory.learning.trust import TrustConfig
from dualbrain.memory.plasticity.rule import BANDWIDTH, Plasticity
from dualbrain.memory.retrieval.search import check_lambda


@dataclass(frozen=True, slots=True, kw_only=True)
class MemoryConfig:
    """`limits` of every robot that uses this memory; the dial is `lambda_s`: 1 trusts likeness, 0 trusts experience.

    A weight gap of 1 outweighs a likeness gap of (1 − λ_s)/λ_s: 0.25 at the default 0.8. `warnings` is how many
    failures are recalled beside the exemplars; `diversity` see `diversity.diverse`. `plasticity` None freezes all
    weights (static retrieval). `trust` holds the defences against pollution.
    """

    limits: tuple[PostureLimits, ...]
    lambda_s: float = 0.8
    max_warnings: int = 2
    diversity: float = 0.0
    plasticity: Plasticity | None = field(default_factory=Plasticity)
    embedding: EmbeddingConfig = field(default_factory=EmbeddingConfig)
    trust: TrustConfig = field(default_factory=TrustConfig)

    @property
    def bandwidth(self) -> float:
        """ℓ, also where nothing is learnt."""
        return self.plasticity.bandwidth if self.plasticity else BANDWIDTH

    def __post_init__(self) -> None:
        """Raise `InvalidSetup` for λ_s outside [0, 1]."""
        check_lambda(self.lambda_s)
