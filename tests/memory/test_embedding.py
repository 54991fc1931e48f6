"""Laws of the joint embedding: unit blocks, the cosine identity, the kernel of the state, versions."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.errors import InvalidSetup, UnknownName
from dualbrain.memory.embedding import EmbeddingConfig, JointEmbedding
from dualbrain.memory.hashing import HashingEncoder
from dualbrain.memory.posture import Posture, PostureLimits, _frequencies, _normals, fourier

from .samples import ARM, OTHER, REST

ENCODER = HashingEncoder(32)
JOINT = JointEmbedding(ENCODER, (ARM, OTHER))
texts = st.text(st.characters(), max_size=30)
postures = st.builds(Posture, st.tuples(st.floats(-3, 3), st.floats(-2, 2)), st.floats(0, 0.04))


@given(texts, texts, postures)
def test_every_embedding_has_unit_length(instruction: str, summary: str, state: Posture) -> None:
    e = JOINT.embed(instruction, summary, state, "arm")
    assert e.shape == (JOINT.dim,)
    assert np.linalg.norm(e) == pytest.approx(1.0, abs=1e-5)


@given(texts, texts, texts, texts, postures, postures)
def test_cosine_is_the_weighted_sum_of_block_cosines(a: str, b: str, c: str, d: str, p: Posture, q: Posture) -> None:
    config = JOINT.config
    rows = [ENCODER.encode([text.encode("utf-8", "replace").decode()])[0] for text in (a, b, c, d)]
    state = fourier(ARM.normalised(p), 128, config.seed, 1.0) @ fourier(ARM.normalised(q), 128, config.seed, 1.0)
    expected = config.instruction * rows[0] @ rows[2] + config.summary * rows[1] @ rows[3] + config.state * state
    assert JOINT.embed(a, b, p, "arm") @ JOINT.embed(c, d, q, "arm") == pytest.approx(expected, abs=1e-5)


def test_the_state_block_is_a_gaussian_kernel() -> None:
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, (300, 8))
    y = x + 0.3 * rng.standard_normal((300, 8))
    got = np.array([fourier(a, 128, 7, 1.0) @ fourier(b, 128, 7, 1.0) for a, b in zip(x, y, strict=True)])
    assert np.abs(got - np.exp(-((x - y) ** 2).sum(axis=1) / 2)).mean() < 0.03


def test_frequencies_are_orthogonal_within_a_block_and_the_same_for_ever() -> None:
    block = _frequencies(8, 64, 7)[:8]
    gram = block @ block.T
    assert np.abs(gram - np.diag(np.diag(gram))).max() < 1e-10
    normals = _normals(7, 4000)
    assert abs(normals.mean()) < 0.05
    assert normals.std() == pytest.approx(1.0, abs=0.05)
    assert _normals(7, 3) == pytest.approx([0.9476673378, -0.5946404515, 0.4071613303], abs=1e-9)


def test_a_limit_is_the_edge_of_the_normalised_posture() -> None:
    assert ARM.normalised(Posture((-3.0, 2.0), 0.02)) == pytest.approx([-1.0, 1.0, 0.0])
    assert ARM.normalised(Posture((-9.0, 9.0), 0.0)) == pytest.approx([-1.0, 1.0, -1.0])


@pytest.mark.parametrize(
    "state", [Posture((0.0,), 0.0), Posture((0.0, float("nan")), 0.0), Posture((0.0, 0.0), np.inf)]
)
def test_a_posture_that_is_none_is_refused(state: Posture) -> None:
    with pytest.raises(InvalidSetup, match="posture"):
        JOINT.embed("", "", state, "arm")


def test_the_version_names_all_that_the_vector_depends_on() -> None:
    moved = PostureLimits("arm", (-3.0, -2.0), (3.0, 2.1), 0.04)
    others = [
        JointEmbedding(HashingEncoder(16), (ARM,)),
        JointEmbedding(ENCODER, (moved,)),
        *(
            JointEmbedding(ENCODER, (ARM,), config)
            for config in (
                EmbeddingConfig(0.4, 0.5, 0.1),
                EmbeddingConfig(features=64),
                EmbeddingConfig(seed=8),
                EmbeddingConfig(bandwidth=2.0),
            )
        ),
    ]
    versions = {JOINT.version("arm"), *(other.version("arm") for other in others)}
    assert len(versions) == 1 + len(others)
    assert JOINT.version("arm") == JointEmbedding(HashingEncoder(32), (OTHER, ARM)).version("arm")


def test_a_robot_without_limits_is_named() -> None:
    with pytest.raises(UnknownName, match=r"'armm' is not a robot of this memory\. Closest: 'arm'"):
        JOINT.embed("", "", REST, "armm")


@pytest.mark.parametrize("weights", [(0.5, 0.5, 0.5), (1.2, -0.1, -0.1), (float("nan"), 0.5, 0.5)])
def test_weights_that_do_not_sum_to_one_are_refused(weights: tuple[float, float, float]) -> None:
    with pytest.raises(InvalidSetup, match="embedding weights"):
        EmbeddingConfig(*weights)


@pytest.mark.parametrize("setting", [{"features": 7}, {"features": 0}, {"bandwidth": 0.0}])
def test_features_that_cannot_be_made_are_refused(setting: dict[str, float]) -> None:
    with pytest.raises(InvalidSetup, match="embedding"):
        EmbeddingConfig(**setting)
