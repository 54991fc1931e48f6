"""A busy machine is no failure: no deadline for an example of a property, three attempts at a test in real time.

Tests in real time run one after another, also those of different workers: two gatekeepers with their robots have four
processes of real-time priority, which two processors cannot serve.
"""

import fcntl
import gc
import os
import sys
import tempfile
import warnings
from pathlib import Path

import pytest
from hypothesis import settings

settings.register_profile("patient", deadline=None)
settings.load_profile("patient")


def pytest_collection_modifyitems(items):
    for item in items:
        if item.get_closest_marker("realtime"):
            item.add_marker(pytest.mark.flaky(reruns=2, reruns_delay=5))


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_runtest_protocol(item):
    """Hold the lock of all workers during a test in real time, with all its attempts."""
    if not item.get_closest_marker("realtime"):
        return (yield)
    with Path(tempfile.gettempdir(), f"dualbrain-tests-in-real-time-{os.getuid()}.lock").open("w") as lock:
        fcntl.flock(lock, fcntl.LOCK_EX)
        return (yield)


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
