"""What an image encoder saw: the features of one picture, as they cross rooms and lie in the ledger."""

from __future__ import annotations

from base64 import b64decode, b64encode

import msgspec
import numpy as np

from dualbrain.errors import InvalidSetup
from dualbrain.memory.embedding.text_encoder import Rows

PICTURE_DIM = 128
"""Length of the features."""


class Picture(msgspec.Struct, frozen=True):
    """Unit features of shape (128,), little-endian float32 in base64, and the `encoder` (name, version) of them."""

    encoder: str
    features: str

    @classmethod
    def of(cls, encoder: str, features: Rows) -> Picture:
        """The picture with these features, normalised; raises `InvalidSetup` if they have no direction."""
        length = float(np.linalg.norm(features))
        if features.shape != (PICTURE_DIM,) or not (np.isfinite(length) and length > 0.0):
            raise InvalidSetup("picture features", got=features.shape, allowed=f"({PICTURE_DIM},), finite, not all 0")
        return cls(encoder, b64encode((features / length).astype("<f4").tobytes()).decode())

    def row(self) -> Rows:
        """The features, shape (128,); raises `InvalidSetup` if they are damaged."""
        try:
            return np.frombuffer(b64decode(self.features, validate=True), "<f4").reshape(PICTURE_DIM)
        except ValueError as error:
            raise InvalidSetup(
                "picture features", got=str(error), allowed=f"{PICTURE_DIM} float32 in base64"
            ) from error
