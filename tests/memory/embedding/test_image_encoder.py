"""The image encoder: recognition of a photograph, similarity of changed images, stored features."""

import json
import os
import sys
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
    ImageEncoder,
    resize_area,
)
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.onnx_session import open_session

CLASSIFIER, BIASES, MILITARY_UNIFORM = 6840952, 5176552, 652
"""Offsets of the unused classifier in the file, and the ImageNet class of the photograph."""
ROWS, COLUMNS = np.mgrid[:180, :240]
SYNTHETIC = {
    "grey": np.full((50, 60, 3), 77, np.uint8),
    "gradients": np.stack([COLUMNS, ROWS, ROWS * COLUMNS // 200], axis=2).astype(np.uint8),
    "texture": np.stack([(ROWS * a + COLUMNS * b) ** 2 % 251 for a, b in ((7, 3), (5, 11), (2, 13))], 2).astype(
        np.uint8
    ),
    "boxes": np.stack([(ROWS > 90) * 120 + (abs(COLUMNS - x) < 25) * 100 for x in (60, 70, 180)], 2).astype(np.uint8),
}
"""Images of integers, the same on every machine."""


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


@pytest.mark.parametrize("name", SYNTHETIC)
def test_the_features_are_those_of_stored_memories(encoder: ImageEncoder, name: str) -> None:
    """Oracle: features that an implementation in NumPy computed from the same weights."""
    stored = json.loads(Path(__file__).with_name("image_features.json").read_text())[name]
    expected = ImageFeatures(IMAGE_ENCODER_ID, stored).to_vector()
    assert encoder.encode(SYNTHETIC[name]).to_vector() == pytest.approx(expected, abs=1e-5)


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


def test_a_missing_runtime_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "onnxruntime", None)
    with pytest.raises(MissingDependencyError, match=r"onnxruntime.*dualbrain\[memory\]"):
        open_session(b"")


def test_image_features_survive_the_json_of_the_ledger(encoder: ImageEncoder, photograph: np.ndarray) -> None:
    features = encoder.encode(photograph)
    assert features.encoder == IMAGE_ENCODER_ID
    assert np.linalg.norm(features.to_vector()) == pytest.approx(1.0, abs=1e-6)
    with pytest.raises(ConfigurationError, match="image features"):
        ImageFeatures(IMAGE_ENCODER_ID, features.features[:-8]).to_vector()
