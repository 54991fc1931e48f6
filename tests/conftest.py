"""A busy machine is no failure: no deadline for an example of a property, five attempts at a test in real time."""

import gc
import sys
import warnings

import pytest
from hypothesis import settings

settings.register_profile("patient", deadline=None)
settings.load_profile("patient")


def pytest_collection_modifyitems(items):
    for item in items:
        if item.get_closest_marker("realtime"):
            item.add_marker(pytest.mark.flaky(reruns=4))


@pytest.hookimpl(tryfirst=True)
def pytest_runtest_setup(item):
    """What a failed attempt left open is closed before the next one: its warning would fail any later test."""
    if getattr(item, "execution_count", 1) == 1:
        return
    for name in ("last_exc", "last_type", "last_value", "last_traceback"):
        if hasattr(sys, name):
            delattr(sys, name)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", ResourceWarning)
        gc.collect()
