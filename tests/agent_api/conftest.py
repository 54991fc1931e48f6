"""Fixtures of tests that replace the gatekeeper by a client of their own."""

import pytest

from dualbrain.runtime.assembly import SimulatedCell


@pytest.fixture(scope="module")
def cell():
    found = SimulatedCell.make("panda", "bare:0")
    found.loop.begin()
    yield found
    found.close()
