"""Image encoder in NumPy: the pooled features of EfficientNet-Lite0 (Tan & Le 2019), projected to 128 dimensions.

The network consists of 1×1 convolutions, depthwise convolutions, ReLU6 and residual sums. NumPy runs it in about 0.1 s,
once per episode, so that no deep-learning package and no pickle file is needed: the weights are read from the pinned
file at the offsets in `data/efficientnet_lite0.json`.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from importlib import resources
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.memory.embedding.image_features import IMAGE_FEATURES_DIM, ImageFeatures
from dualbrain.memory.embedding.posture_features import orthogonal_rows
from dualbrain.memory.embedding.text_encoder import Float32Array

IMAGE_WEIGHTS = "efficientnet-lite0"
"""Name of the weights in the manifest."""
WEIGHTS_SHA256 = "579344248a93e23026e6b78f1f6faf0bc1d282386f6c881cdbaacd49cabf77db"
IMAGE_ENCODER_ID = f"efficientnet-lite0@{WEIGHTS_SHA256[:8]}/{IMAGE_FEATURES_DIM}"
"""Name and version of the encoder, and length of its features."""
INPUT_SIZE, BATCH_NORM_EPSILON, POOLED_FEATURES_DIM = 224, 1e-3, 1280
_STAGES = (
    (1, 3, 1, 1, 16),
    (2, 3, 2, 6, 24),
    (2, 5, 2, 6, 40),
    (3, 3, 2, 6, 80),
    (3, 5, 1, 6, 112),
    (4, 5, 2, 6, 192),
    (1, 3, 1, 6, 320),
)
"""(repeats, kernel, stride, expansion, channels) of each stage; a stem of 32 channels precedes the stages."""


@dataclass(frozen=True, slots=True)
class ConvLayer:
    """A convolution with its batch normalisation folded in.

    `weight` has the shape (k, k, channels) or (in, out), `bias` the shape (out,).
    """

    weight: Float32Array
    bias: Float32Array


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
        self._data = data
        offsets = resources.files("dualbrain.memory").joinpath("data/efficientnet_lite0.json").read_text()
        self._offsets: dict[str, int] = json.loads(offsets)
        self._stem = self._layer("_conv_stem", "_bn0", (3, 3, 3, 32))
        self._blocks = list(self._read_blocks())
        self._head = self._layer("_conv_head", "_bn1", (320, POOLED_FEATURES_DIM))
        del self._data

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
        x = _relu6(_dense(_im2col(x.astype(np.float32), 3, 2), self._stem))
        for expand, depthwise, project, stride in self._blocks:
            y = _relu6(_dense(x, expand)) if expand else x
            y = _relu6(_depthwise(y, depthwise, stride))
            y = _dense(y, project)
            x = y + x if y.shape == x.shape else y
        return _relu6(_dense(x, self._head)).mean(axis=(0, 1))

    def _read_blocks(self) -> Iterator[tuple[ConvLayer | None, ConvLayer, ConvLayer, int]]:
        channels, number = 32, 0
        for repeats, kernel, stride, expansion, out in _STAGES:
            for repeat in range(repeats):
                name, expanded = f"_blocks.{number}.", channels * expansion
                expand = (
                    self._layer(f"{name}_expand_conv", f"{name}_bn0", (channels, expanded)) if expansion > 1 else None
                )
                depthwise = self._layer(f"{name}_depthwise_conv", f"{name}_bn1", (kernel, kernel, expanded))
                project = self._layer(f"{name}_project_conv", f"{name}_bn2", (expanded, out))
                yield expand, depthwise, project, stride if repeat == 0 else 1
                channels, number = out, number + 1

    def _layer(self, name: str, norm: str, shape: tuple[int, ...]) -> ConvLayer:
        """The layer `name` with y = γ (x − μ)/√(σ² + ε) + β of `norm` folded in; axes in the file: H, W, in, out."""
        weight, out = self._read(f"{name}.weight", shape), shape[-1]
        spread = np.sqrt(self._read(f"{norm}.running_var", (out,)) + np.float32(BATCH_NORM_EPSILON))
        scale = (self._read(f"{norm}.weight", (out,)) / spread).astype(np.float32)
        bias = (self._read(f"{norm}.bias", (out,)) - scale * self._read(f"{norm}.running_mean", (out,))).astype(
            np.float32
        )
        scaled: Float32Array = (weight * scale).astype(np.float32)
        return ConvLayer(scaled.reshape(-1, out) if len(shape) == 4 else scaled, bias)

    def _read(self, name: str, shape: tuple[int, ...]) -> Float32Array:
        count = int(np.prod(shape))
        return np.frombuffer(self._data, "<f4", count, self._offsets[name]).reshape(shape)


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


def _pad_same(x: Float32Array, kernel: int, stride: int) -> tuple[Float32Array, int]:
    """`x` padded with zeros for an output of size ⌈n/stride⌉, and that size; an odd row or column goes to the end."""
    size = -(-x.shape[0] // stride)
    pad = max(0, (size - 1) * stride + kernel - x.shape[0])
    edge = (pad // 2, pad - pad // 2)
    return np.pad(x, (edge, edge, (0, 0))), size


def _im2col(x: Float32Array, kernel: int, stride: int) -> Float32Array:
    """All kernel × kernel patches, flattened; shape (size, size, kernel²·channels)."""
    padded, size = _pad_same(x, kernel, stride)
    windows = [
        padded[i : i + size * stride : stride, j : j + size * stride : stride][:size, :size]
        for i in range(kernel)
        for j in range(kernel)
    ]
    return np.concatenate(windows, axis=2)


def _depthwise(x: Float32Array, layer: ConvLayer, stride: int) -> Float32Array:
    kernel = layer.weight.shape[0]
    padded, size = _pad_same(x, kernel, stride)
    total = np.broadcast_to(layer.bias, (size, size, x.shape[2])).copy()
    for i in range(kernel):
        for j in range(kernel):
            window = padded[i : i + size * stride : stride, j : j + size * stride : stride]
            total += window[:size, :size] * layer.weight[i, j]
    return total


def _dense(x: Float32Array, layer: ConvLayer) -> Float32Array:
    return x @ layer.weight + layer.bias


def _relu6(x: Float32Array) -> Float32Array:
    return np.clip(x, 0.0, 6.0)


@lru_cache
def _projection() -> NDArray[np.float64]:
    """128 orthonormal directions in 1280 dimensions, shape (128, 1280); the same on every machine."""
    return orthogonal_rows(IMAGE_FEATURES_DIM, POOLED_FEATURES_DIM, seed=11)
