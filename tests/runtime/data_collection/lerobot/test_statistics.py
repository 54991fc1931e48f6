"""Statistics against NumPy: exact extremes, moments within single precision, quantiles within one bin."""

import numpy as np
import pytest

from dualbrain.runtime.data_collection.lerobot.statistics import (
    QUANTILES,
    STATISTICS,
    aggregate_statistics,
    feature_statistics,
)

RNG = np.random.default_rng(0)
SAMPLES = {
    "vector": RNG.normal(0.5, 2.0, (700, 3)).astype(np.float32),
    "scalar": RNG.uniform(-1.0, 3.0, 999).astype(np.float32),
    "bool": RNG.uniform(size=300) < 0.1,
    "integer": np.arange(5000),
    "constant": np.full(100, 0.3, np.float32),
    "pair": np.array([1.0, 2.0], np.float32),
}


@pytest.mark.parametrize("kind", SAMPLES)
def test_every_statistic_agrees_with_numpy(kind):
    values = SAMPLES[kind]
    found = feature_statistics(values)
    exact = values.reshape(len(values), -1).astype(np.float64)
    assert tuple(found) == STATISTICS
    assert found["count"].tolist() == [len(values)]
    assert np.array_equal(found["min"], exact.min(axis=0))
    assert np.array_equal(found["max"], exact.max(axis=0))
    rounding = len(values) * np.finfo(np.float32).eps * np.abs(exact).max()
    assert np.abs(found["mean"] - exact.mean(axis=0)).max() <= rounding
    assert np.abs(found["std"] ** 2 - exact.var(axis=0)).max() <= 4 * rounding * max(1.0, np.abs(exact).max())
    bin_width = np.ptp(exact, axis=0).max() / 5000
    for name, share in QUANTILES.items():
        low, high = (np.quantile(exact, share, axis=0, method=method) for method in ("lower", "higher"))
        assert (found[name] >= low - 2 * bin_width - rounding).all()
        assert (found[name] <= high + 2 * bin_width + rounding).all()


def test_one_frame_has_its_values_as_all_statistics():
    found = feature_statistics(np.array([[1.5, -2.0]], np.float32))
    assert all(found[name].tolist() == [1.5, -2.0] for name in ("min", "max", "mean", *QUANTILES))
    assert (found["std"].tolist(), found["count"].tolist()) == ([0.0, 0.0], [1])


def test_aggregated_moments_are_those_of_all_frames():
    parts = [SAMPLES["vector"][:100], SAMPLES["vector"][100:107], SAMPLES["vector"][107:]]
    whole = aggregate_statistics([{"a": feature_statistics(part)} for part in parts])["a"]
    exact = SAMPLES["vector"].astype(np.float64)
    assert whole["count"].tolist() == [700]
    assert np.array_equal(whole["min"], exact.min(axis=0))
    assert np.array_equal(whole["max"], exact.max(axis=0))
    assert np.allclose(whole["mean"], exact.mean(axis=0), rtol=0.0, atol=1e-5)
    assert np.allclose(whole["std"], exact.std(axis=0), rtol=0.0, atol=1e-5)
    medians = [feature_statistics(part)["q50"] for part in parts]
    weighted = np.average(medians, axis=0, weights=[len(part) for part in parts])
    assert np.allclose(whole["q50"], weighted, rtol=0.0, atol=1e-9)
