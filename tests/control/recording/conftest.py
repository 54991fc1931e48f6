"""Fixtures of the recording tests."""

import pytest

from tests.support.completed_run import completed_run as finished_run


@pytest.fixture(scope="session")
def completed_run(tmp_path_factory):
    return finished_run(tmp_path_factory)
