"""Configuration of the episodic memory."""

from __future__ import annotations

from dataclasses import dataclass, field

from dualbrain.memory.embedding.joint_embedding import EmbeddingConfig
from dualbrain.memory.embedding.posture_features import PostureLimits
from dualbrain.memory.learning.trust import TrustConfig
from dualbrain.memory.plasticity.hebbian_update import BANDWIDTH, Plasticity
from dualbrain.memory.retrieval.search import check_lambda


@dataclass(frozen=True, slots=True, kw_only=True)
class MemoryConfig:
    """Settings of retrieval, learning and trust, and the posture `limits` of every robot that uses the memory.

    The main setting is λ_s (`lambda_s`): at 1 only similarity ranks the memories, at 0 only their weights. A weight
    gap of 1 outweighs a similarity gap of (1 − λ_s)/λ_s, which is 0.25 at the default 0.8. `max_warnings` is the number
    of failures that are retrieved in addition to the exemplars. `diversity` is the d of `select_diverse`. With
    `plasticity` None all weights are frozen (static retrieval). `trust` configures the defences against pollution.
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
        """Bandwidth ℓ of the neighbourhood, also for a memory whose weights are frozen."""
        return self.plasticity.bandwidth if self.plasticity else BANDWIDTH

    def __post_init__(self) -> None:
        """Raise `ConfigurationError` if λ_s is outside [0, 1]."""
        check_lambda(self.lambda_s)
