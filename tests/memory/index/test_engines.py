"""Every engine keeps a vector once, finds the largest inner products of a group exactly, and reports its absence."""

from importlib.util import find_spec
from itertools import count

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.memory.index.engines.choice import open_engine
from dualbrain.memory.index.engines.engine import EngineUnreachableError
from tests.memory.index.engines_under_test import NumpyEngine

DIM, N = 24, 300
MILVUS = pytest.param("milvus", marks=pytest.mark.skipif(find_spec("pymilvus") is None, reason="the extra milvus"))
_numbers = count()


@pytest.fixture(params=["numpy", "pgvector", MILVUS])
def opened(request, server_url, tmp_path):
    """An empty engine, and a function that opens the same one again."""
    if request.param == "numpy":
        engine = NumpyEngine()
        yield engine, lambda: engine
        return
    name = "pgvector" if request.param == "pgvector" else f"milvus:{tmp_path / 'a.db'}"
    namespace = f"engine_{next(_numbers)}"
    opened = []

    def connect():
        opened.append(open_engine(name, url=server_url, namespace=namespace, dim=DIM))
        return opened[-1]

    yield connect(), connect
    for engine in opened:
        engine.close()


def vectors():
    rng = np.random.default_rng(1)
    return np.arange(3, 3 + N), rng.integers(-(2**62), 2**62, 3)[rng.integers(0, 3, N)], rng.normal(size=(N, DIM))


def pairs(engine):
    return sorted(zip(*(numbers.tolist() for numbers in engine.stored()), strict=True))


def test_each_vector_is_stored_once(opened):
    engine, connect = opened
    seqs, groups, rows = vectors()
    assert pairs(engine) == []
    engine.add(seqs[:200], groups[:200], rows[:200].astype(np.float32))
    engine.add(seqs, groups, rows.astype(np.float32))
    assert pairs(engine) == sorted(zip(seqs.tolist(), groups.tolist(), strict=True))
    engine.close()
    assert pairs(connect()) == sorted(zip(seqs.tolist(), groups.tolist(), strict=True))


@pytest.mark.parametrize("number", [1, 7, 1000])
def test_the_largest_products_of_a_group_are_found(opened, number):
    engine, _ = opened
    seqs, groups, rows = vectors()
    rows = rows.astype(np.float32)
    engine.add(seqs, groups, rows)
    query = np.random.default_rng(2).normal(size=DIM).astype(np.float32)
    for group in np.unique(groups).tolist():
        own = groups == group
        order = np.argsort(-(rows[own] @ query))[:number]
        found, products = engine.nearest(group, query, number)
        assert found.tolist() == seqs[own][order].tolist()
        assert products == pytest.approx((rows[own] @ query)[order], abs=1e-4)
    assert engine.nearest(1, query, number)[0].size == 0


def test_an_engine_that_does_not_answer_and_an_unknown_one_are_reported(tmp_path):
    with pytest.raises(EngineUnreachableError):
        open_engine("pgvector", url=f"postgresql:///a?host={tmp_path}", namespace="a", dim=DIM)
    with pytest.raises(ConfigurationError, match="scan, pgvector or milvus:ADDRESS"):
        open_engine("faiss", url="", namespace="a", dim=DIM)


def test_a_lost_connection_is_opened_again(server_url):
    engine = open_engine("pgvector", url=server_url, namespace=f"engine_{next(_numbers)}", dim=DIM)
    engine._connection.close()
    assert engine.stored()[0].size == 0
    engine.close()
