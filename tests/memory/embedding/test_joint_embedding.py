"""Laws of the joint embedding: unit blocks, the cosine identity, the kernel of the state, versions."""

from dataclasses import astuple, fields

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.memory.embedding.hashing_encoder import HashingEncoder
from dualbrain.memory.embedding.image_encoder import IMAGE_ENCODER_ID
from dualbrain.memory.embedding.image_features import ImageFeatures
from dualbrain.memory.embedding.joint_embedding import BLOCKS, Alpha, EmbeddingConfig, EpisodeEmbedding, JointEmbedding
from dualbrain.memory.embedding.posture_features import (
    Posture,
    PostureLimits,
    _frequencies,
    _standard_normals,
    fourier_features,
)
from dualbrain.memory.embedding.symbol_features import symbol_features
from dualbrain.memory.retrieval.search import FlatIndex, Query
from tests.memory.memory_samples import ARM_LIMITS, OTHER_LIMITS, REST_POSTURE

ENCODER = HashingEncoder(32)
JOINT = JointEmbedding(ENCODER, (ARM_LIMITS, OTHER_LIMITS))
IMAGE = ImageFeatures.from_vector(IMAGE_ENCODER_ID, np.random.default_rng(1).standard_normal(128).astype(np.float32))
OTHER_IMAGE = ImageFeatures.from_vector(
    IMAGE_ENCODER_ID, np.random.default_rng(2).standard_normal(128).astype(np.float32)
)
texts = st.text(st.characters(), max_size=30)
postures = st.builds(Posture, st.tuples(st.floats(-3, 3), st.floats(-2, 2)), st.floats(0, 0.04))


def _cosine(one: EpisodeEmbedding, other: EpisodeEmbedding, alpha: Alpha) -> float:
    """The cosine that retrieval computes."""
    index = FlatIndex(JOINT.dim)
    index.add(one.vector, 0.5, one.mask)
    query = Query(
        other.vector * JOINT.expand_alpha(alpha), other.mask, alpha.weight_by_mask(), JOINT.expand_alpha(alpha)
    )
    return float(index.compare(query).cosine[0])


@given(texts, texts, st.one_of(st.none(), postures), st.booleans())
def test_every_present_block_has_unit_length(a: str, b: str, state: Posture | None, seen: bool) -> None:
    e = JOINT.embed(a, b, state, "arm", IMAGE if seen else None)
    ends = np.cumsum(JOINT.block_dims)
    lengths = [np.linalg.norm(e.vector[end - dim : end]) for dim, end in zip(JOINT.block_dims, ends, strict=True)]
    assert e.vector.shape == (JOINT.dim,)
    assert lengths == pytest.approx([float(e.mask >> block & 1) for block in range(len(BLOCKS))], abs=1e-5)
    present = (bool(a), bool(b), None, seen, state is not None)
    assert all(expected is None or bool(e.mask >> block & 1) == expected for block, expected in enumerate(present))


BLOCK_NAMES = [field.name for field in fields(Alpha)]


@st.composite
def alphas(draw: st.DrawFn) -> Alpha:
    parts = np.array(draw(st.lists(st.floats(0.05, 1.0), min_size=5, max_size=5)))
    return Alpha(**dict(zip(BLOCK_NAMES, (parts / parts.sum()).tolist(), strict=True)))


@given(texts, texts, texts, texts, postures, postures, alphas(), st.sets(st.integers(0, 4), max_size=3))
def test_cosine_is_the_weighted_sum_over_the_blocks_that_both_have(
    a: str, b: str, c: str, d: str, p: Posture, q: Posture, alpha: Alpha, missing: set[int]
) -> None:
    """Law of the query: α may change without a change of the stored vectors, and a missing block does not count."""
    config = JOINT.config
    rows = [ENCODER.encode([text.encode("utf-8", "replace").decode()])[0] for text in (a, b, c, d)]
    kernels = [fourier_features(ARM_LIMITS.normalize(x), 128, config.seed, 1.0) for x in (p, q)]
    left, right = (
        symbol_features(*(x.encode("utf-8", "replace").decode() for x in (a, b))),
        symbol_features(*(x.encode("utf-8", "replace").decode() for x in (c, d))),
    )
    parts = [
        rows[0] @ rows[2] if a and c and 0 not in missing else None,
        rows[1] @ rows[3] if b and d and 1 not in missing else None,
        None,
        float(IMAGE.to_vector() @ OTHER_IMAGE.to_vector()) if 3 not in missing else None,
        kernels[0] @ kernels[1] if 4 not in missing else None,
    ]
    one = JOINT.embed("" if 0 in missing else a, "" if 1 in missing else b, p, "arm", IMAGE)
    other = JOINT.embed(c, d, None if 4 in missing else q, "arm", None if 3 in missing else OTHER_IMAGE)
    if not missing & {0, 1} and left is not None and right is not None:
        parts[2] = left @ right
    elif one.mask & other.mask & 4:
        parts[2] = JOINT.block_cosines(one.vector, other.vector, 4)["symbols"]
    weights = [w for w, part in zip(astuple(alpha), parts, strict=True) if part is not None]
    found = [part for part in parts if part is not None]
    expected = float(np.dot(weights, found) / sum(weights)) if weights else 0.0
    assert _cosine(one, other, alpha) == pytest.approx(expected, abs=2e-5)


def test_symbols_separate_summaries_that_a_sentence_encoder_confuses() -> None:
    near = symbol_features("put the red cube away", "red_cube: object, neighbour_across tall <3cm\nblue_cube: object")
    same = symbol_features("put the green mug away", "green_mug: object, neighbour_across tall <3cm\nred_cube: object")
    far = symbol_features("put the red cube away", "red_cube: object, neighbour_along low 3-6cm\nblue_cube: object")
    assert near is not None
    assert same is not None
    assert far is not None
    assert near @ same == pytest.approx(1.0, abs=1e-6)
    assert near @ far < 0.5
    assert symbol_features("put", "") is None


def test_image_features_of_another_encoder_are_refused() -> None:
    foreign = ImageFeatures.from_vector("resnet@1234/128", np.ones(128, np.float32))
    with pytest.raises(ConfigurationError, match="image encoder: got 'resnet@1234/128', allowed: efficientnet-lite0@"):
        JOINT.embed("a", "b", None, "arm", foreign)


@pytest.mark.parametrize("features", [np.zeros(128), np.full(128, np.nan), np.ones(4)])
def test_features_without_a_direction_are_refused(features: np.ndarray) -> None:
    with pytest.raises(ConfigurationError, match="image features"):
        ImageFeatures.from_vector(IMAGE_ENCODER_ID, features.astype(np.float32))


def test_the_state_block_is_a_gaussian_kernel() -> None:
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (300, 8))
    y = x + 0.3 * rng.standard_normal((300, 8))
    got = np.array(
        [fourier_features(a, 128, 7, 1.0) @ fourier_features(b, 128, 7, 1.0) for a, b in zip(x, y, strict=True)]
    )
    assert np.abs(got - np.exp(-((x - y) ** 2).sum(axis=1) / 2)).mean() < 0.03


def test_frequencies_are_orthogonal_within_a_block_and_never_change() -> None:
    block = _frequencies(8, 64, 7)[:8]
    gram = block @ block.T
    assert np.abs(gram - np.diag(np.diag(gram))).max() < 1e-10
    normals = _standard_normals(7, 4000)
    assert abs(normals.mean()) < 0.05
    assert normals.std() == pytest.approx(1.0, abs=0.05)
    assert _standard_normals(7, 3) == pytest.approx([0.9476673378, -0.5946404515, 0.4071613303], abs=1e-9)


def test_limits_map_to_the_bounds_of_the_normalised_posture() -> None:
    assert ARM_LIMITS.normalize(Posture((-3.0, 2.0), 0.02)) == pytest.approx([-1.0, 1.0, 0.0])
    assert ARM_LIMITS.normalize(Posture((-9.0, 9.0), 0.0)) == pytest.approx([-1.0, 1.0, -1.0])


@pytest.mark.parametrize(
    "state", [Posture((0.0,), 0.0), Posture((0.0, float("nan")), 0.0), Posture((0.0, 0.0), np.inf)]
)
def test_an_invalid_posture_is_refused(state: Posture) -> None:
    with pytest.raises(ConfigurationError, match="posture"):
        JOINT.embed("", "", state, "arm")


def test_the_version_names_everything_that_determines_the_vector() -> None:
    moved = PostureLimits("arm", (-3.0, -2.0), (3.0, 2.1), 0.04)
    others = [
        JointEmbedding(HashingEncoder(16), (ARM_LIMITS,)),
        JointEmbedding(ENCODER, (moved,)),
        *(
            JointEmbedding(ENCODER, (ARM_LIMITS,), config)
            for config in (
                EmbeddingConfig(features=64),
                EmbeddingConfig(seed=8),
                EmbeddingConfig(bandwidth=2.0),
            )
        ),
    ]
    versions = {JOINT.version("arm"), *(other.version("arm") for other in others)}
    assert len(versions) == 1 + len(others)
    assert JOINT.version("arm") == JointEmbedding(HashingEncoder(32), (OTHER_LIMITS, ARM_LIMITS)).version("arm")


def test_a_robot_without_limits_is_named() -> None:
    with pytest.raises(UnknownNameError, match=r"'armm' is not a robot of this memory\. Closest: 'arm'"):
        JOINT.embed("", "", REST_POSTURE, "armm")


@pytest.mark.parametrize("weights", [(0.5,) * 5, (1.2, -0.1, -0.1, 0.0, 0.0), (float("nan"), 0.5, 0.5, 0.0, 0.0)])
def test_weights_that_do_not_sum_to_one_are_refused(weights: tuple[float, ...]) -> None:
    with pytest.raises(ConfigurationError, match="embedding weights"):
        Alpha(**dict(zip(BLOCK_NAMES, weights, strict=True)))


@pytest.mark.parametrize("setting", [{"features": 7}, {"features": 0}, {"bandwidth": 0.0}])
def test_an_invalid_embedding_configuration_is_refused(setting: dict[str, float]) -> None:
    with pytest.raises(ConfigurationError, match="embedding"):
        EmbeddingConfig(**setting)
