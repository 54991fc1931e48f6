"""Image encoder: the pooled features of EfficientNet-Lite0 (Tan & Le 2019), projected to 128 dimensions.

ONNX Runtime runs the graph `data/efficientnet_lite0.onnx`. The graph contains no weights; its tensors are places in the
pinned .pth file, whose bytes are read as numbers, so that no deep-learning package is needed and no pickle is executed.
`tools/image_encoder_graph.py` writes the graph.
"""

from __future__ import annotations

import hashlib
from functools import lru_cache
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dualbrain.core.encoder import Float32Array
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.memory.embedding.image_features import IMAGE_FEATURES_DIM, ImageFeatures
from dualbrain.memory.embedding.onnx_session import open_session
from dualbrain.memory.embedding.posture_features import orthogonal_rows

IMAGE_WEIGHTS = "efficientnet-lite0"
"""Name of the weights in the manifest."""
WEIGHTS_SHA256 = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"
IMAGE_ENCODER_ID = f"efficientnet-lite0@{WEIGHTS_SHA256[:8]}/{IMAGE_FEATURES_DIM}"
"""Name and version of the encoder, and length of its features."""
GRAPH = resources.files("dualbrain.memory").joinpath("data/efficientnet_lite0.onnx")
WEIGHTS_FILE = "efficientnet-lite0.pth"
"""Name of the file of weights in the graph."""
INPUT_SIZE, POOLED_FEATURES_DIM = 224, 1280


class ImageEncoder:
    """Maps an image to unit features of shape (128,): 1280 pooled features, projected by a fixed orthogonal matrix.

    The error of the cosine through the projection is about (1 − cos²)/√128 (Johnson & Lindenstrauss 1984), which is
    small for similar images. The features were trained on photographs (ImageNet) and share no space with text.
    """

    id = IMAGE_ENCODER_ID

    def __init__(self, weights: Path) -> None:
        """Read the pinned weights; raises `MissingDependencyError` or `ConfigurationError`."""
        if not weights.is_file():
            fix = f"Fetch it with `dualbrain models fetch {IMAGE_WEIGHTS}`. Expected file: {weights}"
            raise MissingDependencyError(f"The image encoder's file {weights.name}", fix=fix)
        data = weights.read_bytes()
        if (got := hashlib.sha256(data).hexdigest()) != WEIGHTS_SHA256:
            raise ConfigurationError("image encoder weights", got=got, allowed=WEIGHTS_SHA256, fix=str(weights))
        self._session = open_session(GRAPH.read_bytes(), {WEIGHTS_FILE: data})

    def encode(self, pixels: NDArray[np.uint8]) -> ImageFeatures:
        """The features of an image of shape (height, width, 3), uint8 RGB, of any size."""
        features = self.pooled_features(pixels)
        return ImageFeatures.from_vector(self.id, (_projection() @ features).astype(np.float32))

    def pooled_features(self, pixels: NDArray[np.uint8]) -> Float32Array:
        """The pooled features, shape (1280,); raises `ConfigurationError` for an array of another shape or type."""
        if pixels.ndim != 3 or pixels.shape[2] != 3 or pixels.dtype != np.uint8 or 0 in pixels.shape:
            raise ConfigurationError(
                "image", got=(pixels.shape, str(pixels.dtype)), allowed="(height, width, 3) of uint8"
            )
        x = (resize_area(pixels, INPUT_SIZE) - 127.0) / 128.0
        outputs = self._session.run(None, {"pixels": np.moveaxis(x, 2, 0)[None]})
        return np.asarray(outputs[0], np.float32).ravel()


def resize_area(pixels: NDArray[np.uint8], side: int) -> NDArray[np.float32]:
    """The image at `side` × `side` pixels, each the mean over the area that it covers; shape (side, side, 3)."""
    rows, columns = _area_weights(pixels.shape[0], side), _area_weights(pixels.shape[1], side)
    return np.einsum("ih,hwc,jw->ijc", rows, pixels.astype(np.float32), columns, optimize=True)


def _area_weights(length: int, side: int) -> Float32Array:
    """Share of each input pixel in each output pixel, shape (side, length)."""
    edges = np.linspace(0.0, length, side + 1)
    cells = np.arange(length)
    overlap = np.minimum(edges[1:, None], cells + 1.0) - np.maximum(edges[:-1, None], cells)
    share = np.clip(overlap, 0.0, None)
    return (share / share.sum(axis=1, keepdims=True)).astype(np.float32)


@lru_cache
def _projection() -> NDArray[np.float64]:
    """128 orthonormal directions in 1280 dimensions, shape (128, 1280); the same on every machine."""
    return orthogonal_rows(IMAGE_FEATURES_DIM, POOLED_FEATURES_DIM, seed=11)
