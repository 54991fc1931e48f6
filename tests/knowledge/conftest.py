"""Libraries for tests, with the hashing encoder: an empty one, and one with the built-in documents."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from dualbrain.knowledge.builtin_documents import add_builtin_documents
from dualbrain.knowledge.library import Library
from dualbrain.memory.embedding.hashing_encoder import HashingEncoder

NOW = 1_800_000_000.0


@pytest.fixture
def library(tmp_path: Path) -> Iterator[Library]:
    """An empty library that can be written."""
    with Library(tmp_path / "knowledge.sqlite", HashingEncoder(64), write=True) as opened:
        yield opened


@pytest.fixture(scope="session")
def builtin_library(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Library]:
    """A library with the built-in documents; tests must not change it."""
    path = tmp_path_factory.mktemp("builtin") / "knowledge.sqlite"
    with Library(path, HashingEncoder(64), write=True) as opened:
        add_builtin_documents(opened, now=NOW)
        yield opened
