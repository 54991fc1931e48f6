"""The joint embedding e_i of an episode (paper 5.1): weighted unit blocks of language and state."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from dualbrain.errors import InvalidSetup, UnknownName
from dualbrain.memory.encoder import Encoder, Rows
from dualbrain.memory.posture import Posture, PostureLimits, fourier


@dataclass(frozen=True, slots=True)
class EmbeddingConfig:
    """How much each block counts: the cosine of two episodes is Σ_b α_b cos_b, and the weights α sum to 1.

    `instruction` says what is wanted and leads. `summary`, the scene in words, is the second language block and nearly
    as heavy, because the best contract for the same words depends on the scene. `state` is light: most episodes start
    from the same posture. The visual-semantic block of the paper becomes a fourth weight and thereby a new version.
    """

    instruction: float = 0.5
    summary: float = 0.4
    state: float = 0.1
    features: int = 128
    seed: int = 7
    bandwidth: float = 1.0

    def __post_init__(self) -> None:
        """Raise `InvalidSetup` for weights that do not sum to 1, odd feature counts and bandwidths not above 0."""
        weights = (self.instruction, self.summary, self.state)
        if not (min(weights) >= 0.0 and math.isclose(sum(weights), 1.0, abs_tol=1e-9)):
            raise InvalidSetup("embedding weights", got=weights, allowed="each at least 0, together 1")
        if self.features < 2 or self.features % 2:
            raise InvalidSetup("embedding features", got=self.features, allowed="an even number from 2")
        if not 0.0 < self.bandwidth < math.inf:
            raise InvalidSetup("embedding bandwidth", got=self.bandwidth, allowed="above 0 and finite")


@dataclass(frozen=True, slots=True)
class JointEmbedding:
    """e = [√α_i·instruction, √α_s·summary, √α_x·state], each block of unit length, so ‖e‖ = 1 (paper 5.1).

    Without the unit blocks the block with the largest numbers would decide alone.
    """

    encoder: Encoder
    limits: tuple[PostureLimits, ...]
    config: EmbeddingConfig = field(default_factory=EmbeddingConfig)

    @property
    def dim(self) -> int:
        """Length of e."""
        return 2 * self.encoder.dim + self.config.features

    def version(self, robot: str) -> str:
        """Everything that a vector of `robot` depends on besides its episode; vectors of two versions never meet."""
        c = self.config
        return (
            f"{self.encoder.id} instruction={c.instruction} summary={c.summary} state={c.state} "
            f"features={c.features} seed={c.seed} bandwidth={c.bandwidth} limits={self._limits(robot).fingerprint}"
        )

    def embed(self, instruction: str, summary: str, state: Posture, robot: str) -> Rows:
        """The unit vector e of shape (dim,), float32; raises `UnknownName` for a robot without limits."""
        c, limits = self.config, self._limits(robot)
        language = self.encoder.encode([_encodable(instruction), _encodable(summary)])
        posture = fourier(limits.normalised(state), c.features, c.seed, c.bandwidth)
        blocks = ((c.instruction, language[0]), (c.summary, language[1]), (c.state, posture))
        return np.concatenate([math.sqrt(weight) * block for weight, block in blocks]).astype(np.float32)

    def knows(self, robot: str) -> bool:
        """True if the limits of `robot` were given."""
        return any(limits.robot == robot for limits in self.limits)

    def _limits(self, robot: str) -> PostureLimits:
        for limits in self.limits:
            if limits.robot == robot:
                return limits
        raise UnknownName("robot", robot, tuple(limits.robot for limits in self.limits), owner="this memory")


def _encodable(text: str) -> str:
    """The text with lone surrogates, which tokenizers refuse, replaced by "?"."""
    return text.encode("utf-8", "replace").decode("utf-8")
