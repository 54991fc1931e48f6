"""A gatekeeper with a wrong setup leaves the process of its caller as it was."""

import os
import signal
import sys

import pytest

from dualbrain.control.gatekeeper.config import GatekeeperConfig
from dualbrain.control.gatekeeper.process import run_gatekeeper
from dualbrain.errors import UnknownNameError
from dualbrain.simulation.scenes.generators.catalogue import open_scene


@pytest.mark.skipif(not hasattr(os, "SCHED_FIFO"), reason="the system has no real-time priorities")
def test_a_wrong_setup_gives_the_real_time_priority_back(tmp_path, monkeypatch):
    monkeypatch.setattr(signal, "signal", lambda number, handler: None)
    monkeypatch.setattr(sys, "setswitchinterval", lambda seconds: None)
    keys = str(tmp_path / "missing.keys")
    config = GatekeeperConfig(robot="unknown", scene=open_scene("bare:0"), socket=str(tmp_path / "socket"), keys=keys)
    with pytest.raises(UnknownNameError):
        run_gatekeeper(config)
    assert os.sched_getscheduler(0) == os.SCHED_OTHER
