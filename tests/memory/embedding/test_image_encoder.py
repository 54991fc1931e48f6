"""The image encoder: recognition of a photograph, similarity of changed images, oracles for each operation."""

import os
from pathlib import Path

import matplotlib.cbook
import matplotlib.image
import numpy as np
import pytest

from dualbrain.core.weights import MANIFEST, default_cache_folder, locate_weights
from dualbrain.errors import ConfigurationError, MissingDependencyError
from dualbrain.memory.embedding.image_encoder import (
    IMAGE_ENCODER_ID,
    IMAGE_WEIGHTS,
    ConvLayer,
    ImageEncoder,
    _depthwise,
    _im2col,
    resize_area,
)
from dualbrain.memory.embedding.image_features import ImageFeatures

CLASSIFIER, BIASES, MILITARY_UNIFORM = 6840952, 5176552, 652
"""Offsets of the unused classifier in the file, and the ImageNet class of the photograph."""


@pytest.fixture(scope="module")
def path() -> Path:
    return locate_weights(IMAGE_WEIGHTS, default_cache_folder(os.environ))


@pytest.fixture(scope="module")
def encoder(path: Path) -> ImageEncoder:
    return ImageEncoder(path)


@pytest.fixture(scope="module")
def photograph() -> np.ndarray:
    """Grace Hopper in uniform, a common test image for classifiers."""
    with matplotlib.cbook.get_sample_data("grace_hopper.jpg") as file:
        return matplotlib.image.imread(file, format="jpg")


def test_a_photograph_is_recognised(encoder: ImageEncoder, path: Path, photograph: np.ndarray) -> None:
    """Oracle: the classifier that was trained on these features names the uniform."""
    data = path.read_bytes()
    weights = np.frombuffer(data, "<f4", 1280 * 1000, CLASSIFIER).reshape(1280, 1000)
    scores = encoder.pooled_features(photograph) @ weights + np.frombuffer(data, "<f4", 1000, BIASES)
    assert int(np.argmax(scores)) == MILITARY_UNIFORM


def test_similarity_decreases_with_difference(encoder: ImageEncoder, photograph: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    noisy = np.clip(photograph + rng.normal(0.0, 8.0, photograph.shape), 0, 255).astype(np.uint8)
    other = rng.integers(0, 256, (64, 80, 3), np.uint8)
    rows = [encoder.encode(pixels).to_vector() for pixels in (photograph, noisy, photograph[::-1], other)]
    similarity = [float(rows[0] @ row) for row in rows]
    assert similarity == sorted(similarity, reverse=True)
    assert similarity[0] == pytest.approx(1.0, abs=1e-6)
    assert similarity[1] > 0.9 > 0.6 > similarity[3]


def test_the_projection_preserves_cosines(encoder: ImageEncoder, photograph: np.ndarray) -> None:
    images = [photograph, photograph[:, ::-1], photograph[::-1], photograph[100:300, 100:300]]
    long = np.stack([encoder.pooled_features(pixels) for pixels in images])
    long /= np.linalg.norm(long, axis=1, keepdims=True)
    short = np.stack([encoder.encode(pixels).to_vector() for pixels in images])
    cosines = long @ long.T
    bound = 3.0 * (1.0 - cosines**2) / np.sqrt(128) + 1e-3
    assert (np.abs(cosines - short @ short.T) < bound).all()


def test_a_convolution_matches_its_definition() -> None:
    """Oracle: the sum over the window, pixel by pixel."""
    rng = np.random.default_rng(1)
    for size, kernel, stride in ((7, 3, 1), (8, 3, 2), (9, 5, 2), (6, 5, 1)):
        x = rng.standard_normal((size, size, 2)).astype(np.float32)
        layer = ConvLayer(
            rng.standard_normal((kernel, kernel, 2)).astype(np.float32), rng.standard_normal(2).astype(np.float32)
        )
        out = -(-size // stride)
        before = max(0, (out - 1) * stride + kernel - size) // 2
        expected = np.zeros((out, out, 2))
        for i, j, a, b in np.ndindex(out, out, kernel, kernel):
            r, c = i * stride + a - before, j * stride + b - before
            if 0 <= r < size and 0 <= c < size:
                expected[i, j] += x[r, c] * layer.weight[a, b]
        assert _depthwise(x, layer, stride) == pytest.approx(expected + layer.bias, abs=1e-5)
        patches = _im2col(x, kernel, stride).reshape(out, out, kernel, kernel, 2)
        assert (patches * layer.weight).sum(axis=(2, 3)) == pytest.approx(expected, abs=1e-5)


@pytest.mark.parametrize("shape", [(224, 224), (448, 448), (100, 500), (3, 2)])
def test_resizing_preserves_means_and_uniform_images(shape: tuple[int, int]) -> None:
    uniform = np.full((*shape, 3), 77, np.uint8)
    assert resize_area(uniform, 224) == pytest.approx(np.full((224, 224, 3), 77.0), abs=1e-3)
    pixels = np.random.default_rng(2).integers(0, 256, (*shape, 3), np.uint8)
    assert resize_area(pixels, 224).mean(axis=(0, 1)) == pytest.approx(pixels.mean(axis=(0, 1)), abs=0.05)


@pytest.mark.parametrize("pixels", [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3)), np.zeros((0, 4, 3), np.uint8)])
def test_an_array_that_is_not_an_image_is_refused(encoder: ImageEncoder, pixels: np.ndarray) -> None:
    with pytest.raises(ConfigurationError, match="image: got"):
        encoder.encode(pixels)


def test_other_weights_and_missing_weights_are_refused(tmp_path: Path) -> None:
    (tmp_path / "x.pth").write_bytes(b"not the weights")
    with pytest.raises(ConfigurationError, match="image encoder weights"):
        ImageEncoder(tmp_path / "x.pth")
    with pytest.raises(MissingDependencyError, match="models fetch efficientnet-lite0"):
        ImageEncoder(tmp_path / "nothing")
    assert MANIFEST[IMAGE_WEIGHTS].licence == "Apache-2.0"


def test_image_features_survive_the_json_of_the_ledger(encoder: ImageEncoder, photograph: np.ndarray) -> None:
    features = encoder.encode(photograph)
    assert features.encoder == IMAGE_ENCODER_ID
    assert np.linalg.norm(features.to_vector()) == pytest.approx(1.0, abs=1e-6)
    with pytest.raises(ConfigurationError, match="image features"):
        ImageFeatures(IMAGE_ENCODER_ID, features.features[:-8]).to_vector()
