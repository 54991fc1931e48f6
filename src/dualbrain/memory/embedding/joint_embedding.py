"""The joint embedding e_i of an episode (paper 5.1): unit blocks of language, visual semantics and state."""

from __future__ import annotations

import math
from dataclasses import astuple, dataclass, field

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.encoder import Encoder, Float32Array
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.memory.embedding.image_encoder import IMAGE_ENCODER_ID
from dualbrain.memory.embedding.image_features import IMAGE_FEATURES_DIM, ImageFeatures
from dualbrain.memory.embedding.posture_features import Posture, PostureLimits, fourier_features
from dualbrain.memory.embedding.symbol_features import SYMBOLS_DIM, SYMBOLS_VERSION, symbol_features

BLOCKS = ("instruction", "summary", "symbols", "image", "state")
"""The blocks in their order; bit b of a mask is set if block b is present."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Alpha:
    """Weights α of the blocks: the cosine of two episodes is Σ_b α_b cos_b, and the weights sum to 1.

    `instruction` has the largest weight, because it states the goal. `summary`, the scene in words, is the second
    language block. `symbols` and `image` are the visual-semantic blocks: scene symbols and image features. `state` has
    a small weight, because most episodes start from the same posture. Each query may use other weights: they are not
    part of the stored vectors.
    """

    instruction: float = 0.4
    summary: float = 0.25
    symbols: float = 0.15
    image: float = 0.1
    state: float = 0.1

    def __post_init__(self) -> None:
        """Raise `ConfigurationError` for negative weights and for weights that do not sum to 1."""
        weights = astuple(self)
        if not (min(weights) >= 0.0 and math.isclose(sum(weights), 1.0, abs_tol=1e-9)):
            raise ConfigurationError("embedding weights", got=weights, allowed="each at least 0, together 1")

    def weight_by_mask(self) -> NDArray[np.float64]:
        """Σ_b α_b over the blocks of each mask, shape (32,)."""
        bits = np.arange(1 << len(BLOCKS))[:, None] >> np.arange(len(BLOCKS)) & 1
        return bits.astype(np.float64) @ np.array(astuple(self))


@dataclass(frozen=True, slots=True)
class EmbeddingConfig:
    """Weights of the blocks, and the random Fourier features of the state: number, seed and kernel bandwidth."""

    alpha: Alpha = field(default_factory=Alpha)
    features: int = 128
    seed: int = 7
    bandwidth: float = 1.0

    def __post_init__(self) -> None:
        """Raise `ConfigurationError` for an odd number of features and a bandwidth that is not above 0."""
        if self.features < 2 or self.features % 2:
            raise ConfigurationError("embedding features", got=self.features, allowed="an even number from 2")
        if not 0.0 < self.bandwidth < math.inf:
            raise ConfigurationError("embedding bandwidth", got=self.bandwidth, allowed="above 0 and finite")


@dataclass(frozen=True, slots=True)
class EpisodeEmbedding:
    """The concatenated unit blocks of one episode, shape (dim,); a block that is missing in `mask` is zero.

    A missing block is never imputed: two episodes are compared by the blocks that both have,
    cos = Σ_b α_b cos_b / Σ_b α_b over these blocks.
    """

    vector: Float32Array
    mask: int


@dataclass(frozen=True, slots=True)
class JointEmbedding:
    """e = [instruction, summary, symbols, image, state], each block of unit length; the query applies α.

    Without the normalisation the block with the largest values would dominate the cosine.
    """

    encoder: Encoder
    limits: tuple[PostureLimits, ...]
    config: EmbeddingConfig = field(default_factory=EmbeddingConfig)

    @property
    def block_dims(self) -> tuple[int, ...]:
        """Length of each block, in the order of `BLOCKS`."""
        return self.encoder.dim, self.encoder.dim, SYMBOLS_DIM, IMAGE_FEATURES_DIM, self.config.features

    @property
    def dim(self) -> int:
        """Length of e."""
        return sum(self.block_dims)

    def version(self, robot: str) -> str:
        """Name of everything besides the episode that determines a vector of `robot`.

        Vectors of different versions are never compared.
        """
        c = self.config
        return (
            f"{self.encoder.id} {SYMBOLS_VERSION} {IMAGE_ENCODER_ID} features={c.features} seed={c.seed} "
            f"bandwidth={c.bandwidth} limits={self._limits(robot).fingerprint}"
        )

    def embed(
        self, instruction: str, summary: str, state: Posture | None, robot: str, image: ImageFeatures | None = None
    ) -> EpisodeEmbedding:
        """The blocks of one episode; "" and None stand for missing blocks.

        Raises `UnknownNameError` for a robot without limits and `ConfigurationError` for image features of another
        encoder.
        """
        c, limits = self.config, self._limits(robot)
        if image is not None and image.encoder != IMAGE_ENCODER_ID:
            raise ConfigurationError("image encoder", got=image.encoder, allowed=IMAGE_ENCODER_ID)
        texts = [_replace_surrogates(text) for text in (instruction, summary)]
        language = self.encoder.encode(texts)
        blocks = (
            language[0] if texts[0] else None,
            language[1] if texts[1] else None,
            symbol_features(*texts),
            image.to_vector() if image else None,
            fourier_features(limits.normalize(state), c.features, c.seed, c.bandwidth) if state else None,
        )
        rows = [np.zeros(dim) if block is None else block for dim, block in zip(self.block_dims, blocks, strict=True)]
        mask = sum(1 << b for b, block in enumerate(blocks) if block is not None)
        return EpisodeEmbedding(np.concatenate(rows).astype(np.float32), mask)

    def expand_alpha(self, alpha: Alpha) -> Float32Array:
        """α_b repeated over the entries of block b, shape (dim,); its product with a row is the query [α_b v_b]."""
        return np.repeat(np.array(astuple(alpha), np.float32), self.block_dims)

    def block_cosines(self, one: Float32Array, other: Float32Array, mask: int) -> dict[str, float]:
        """The cosine of each block that is in `mask`."""
        ends = np.cumsum(self.block_dims)
        return {
            name: float(one[end - dim : end] @ other[end - dim : end])
            for b, (name, dim, end) in enumerate(zip(BLOCKS, self.block_dims, ends, strict=True))
            if mask >> b & 1
        }

    def supports(self, robot: str) -> bool:
        """Whether this embedding has the limits of `robot`."""
        return any(limits.robot == robot for limits in self.limits)

    def _limits(self, robot: str) -> PostureLimits:
        for limits in self.limits:
            if limits.robot == robot:
                return limits
        raise UnknownNameError("robot", robot, tuple(limits.robot for limits in self.limits), owner="this memory")


def _replace_surrogates(text: str) -> str:
    """The text with lone surrogates, which tokenizers refuse, replaced by "?"."""
    return text.encode("utf-8", "replace").decode("utf-8")
