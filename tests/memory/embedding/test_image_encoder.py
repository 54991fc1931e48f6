"""The image encoder: a photograph is recognised, likeness falls with difference, each part is its definition."""

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
"""Where the classifier that we do not use lies in the file, and the class of the photograph (ImageNet)."""


@pytest.fixture(scope="module")
def path() -> Path:
    return locate_weights(IMAGE_WEIGHTS, default_cache_folder(os.environ))


@pytest.fixture(scope="module")
def encoder(path: Path) -> ImageEncoder:
    return ImageEncoder(path)


@pytest.fixture(scope="module")
def photograph() -> np.ndarray:
    """Grace Hopper in uniform, the usual test picture of classifiers."""
    with matplotlib.cbook.get_sample_data("grace_hopper.jpg") as file:
        return matplotlib.image.imread(file, format="jpg")


def test_a_photograph_is_recognised(encoder: ImageEncoder, path: Path, photograph: np.ndarray) -> None:
    """Oracle: the classifier that was trained on these features names the uniform."""
    data = path.read_bytes()
    weights = np.frombuffer(data, "<f4", 1280 * 1000, CLASSIFIER).reshape(1280, 1000)
    scores = encoder.pooled_features(photograph) @ weights + np.frombuffer(data, "<f4", 1000, BIASES)
    assert int(np.argmax(scores)) == MILITARY_UNIFORM


def test_likeness_falls_with_difference(encoder: ImageEncoder, photograph: np.ndarray) -> None:
    rng = np.random.default_rng(0)
    noisy = np.clip(photograph + rng.normal(0.0, 8.0, photograph.shape), 0, 255).astype(np.uint8)
    other = rng.integers(0, 256, (64, 80, 3), np.uint8)
    rows = [encoder.encode(pixels).to_vector() for pixels in (photograph, noisy, photograph[::-1], other)]
    likeness = [float(rows[0] @ row) for row in rows]
    assert likeness == sorted(likeness, reverse=True)
    assert likeness[0] == pytest.approx(1.0, abs=1e-6)
    assert likeness[1] > 0.9 > 0.6 > likeness[3]


def test_the_projection_keeps_cosines(encoder: ImageEncoder, photograph: np.ndarray) -> None:
    pictures = [photograph, photograph[:, ::-1], photograph[::-1], photograph[100:300, 100:300]]
    long = np.stack([encoder.pooled_features(pixels) for pixels in pictures])
    long /= np.linalg.norm(long, axis=1, keepdims=True)
    short = np.stack([encoder.encode(pixels).to_vector() for pixels in pictures])
    cosines = long @ long.T
    bound = 3.0 * (1.0 - cosines**2) / np.sqrt(128) + 1e-3
    assert (np.abs(cosines - short @ short.T) < bound).all()


def test_a_convolution_is_its_definition() -> None:
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
def test_resizing_keeps_means_and_flat_pictures(shape: tuple[int, int]) -> None:
    flat = np.full((*shape, 3), 77, np.uint8)
    assert resize_area(flat, 224) == pytest.approx(np.full((224, 224, 3), 77.0), abs=1e-3)
    pixels = np.random.default_rng(2).integers(0, 256, (*shape, 3), np.uint8)
    assert resize_area(pixels, 224).mean(axis=(0, 1)) == pytest.approx(pixels.mean(axis=(0, 1)), abs=0.05)


@pytest.mark.parametrize("pixels", [np.zeros((4, 4), np.uint8), np.zeros((4, 4, 3)), np.zeros((0, 4, 3), np.uint8)])
def test_what_is_no_picture_is_refused(encoder: ImageEncoder, pixels: np.ndarray) -> None:
    with pytest.raises(ConfigurationError, match="picture"):
        encoder.encode(pixels)


def test_other_weights_and_missing_ones_are_refused(tmp_path: Path) -> None:
    (tmp_path / "x.pth").write_bytes(b"not the weights")
    with pytest.raises(ConfigurationError, match="image encoder weights"):
        ImageEncoder(tmp_path / "x.pth")
    with pytest.raises(MissingDependencyError, match="models fetch efficientnet-lite0"):
        ImageEncoder(tmp_path / "nothing")
    assert MANIFEST[IMAGE_WEIGHTS].licence == "Apache-2.0"


def test_a_picture_survives_the_ledgers_json(encoder: ImageEncoder, photograph: np.ndarray) -> None:
    picture = encoder.encode(photograph)
    assert picture.encoder == IMAGE_ENCODER_ID
    assert np.linalg.norm(picture.to_vector()) == pytest.approx(1.0, abs=1e-6)
    with pytest.raises(ConfigurationError, match="picture features"):
        ImageFeatures(IMAGE_ENCODER_ID, picture.features[:-8]).to_vector()
