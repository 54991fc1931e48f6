"""Fixtures of the runtime's tests."""

import pytest

from tests.support.completed_run import finished as finished_run


@pytest.fixture(scope="session")
def finished(tmp_path_factory):
    return finished_run(tmp_path_factory)
