"""Features of one image, as packages exchange them and the ledger stores them."""

from __future__ import annotations

from base64 import b64decode, b64encode

import msgspec
import numpy as np

from dualbrain.core.encoder import Float32Array
from dualbrain.errors import ConfigurationError

IMAGE_FEATURES_DIM = 128
"""Length of the features."""


class ImageFeatures(msgspec.Struct, frozen=True):
    """Unit features of shape (128,), as little-endian float32 in base64, and name and version of their `encoder`."""

    encoder: str
    features: str

    @classmethod
    def from_vector(cls, encoder: str, features: Float32Array) -> ImageFeatures:
        """These features, normalised; raises `ConfigurationError` if their norm is 0 or not finite."""
        length = float(np.linalg.norm(features))
        if features.shape != (IMAGE_FEATURES_DIM,) or not (np.isfinite(length) and length > 0.0):
            raise ConfigurationError(
                "image features", got=features.shape, allowed=f"({IMAGE_FEATURES_DIM},), finite, not all 0"
            )
        return cls(encoder, b64encode((features / length).astype("<f4").tobytes()).decode())

    def to_vector(self) -> Float32Array:
        """The features, shape (128,), float32; raises `ConfigurationError` if they are damaged."""
        try:
            return np.frombuffer(b64decode(self.features, validate=True), "<f4").reshape(IMAGE_FEATURES_DIM)
        except ValueError as error:
            raise ConfigurationError(
                "image features", got=str(error), allowed=f"{IMAGE_FEATURES_DIM} float32 in base64"
            ) from error
