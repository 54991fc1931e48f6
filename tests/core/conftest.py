"""Fixtures of the core tests."""

import pytest

from tests.support.small_disk import mounted_disk


@pytest.fixture
def small_disk(tmp_path):
    with mounted_disk(tmp_path / "disk", 16) as folder:
        yield folder
