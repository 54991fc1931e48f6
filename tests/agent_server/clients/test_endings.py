"""The end of a server, of each kind: gatekeeper, gate and robot end with it, also during a motion and if one hangs."""

import json
import os
import signal
import time
from pathlib import Path

import pytest

from dualbrain.agent_api.executions import CLOSED
from tests.agent_server.clients.running_server import HttpServer, StdioServer, running
from tests.agent_server.clients.test_clients import environment  # noqa: F401  (a fixture)

pytestmark = pytest.mark.realtime

END_TIME = 2.0
"""Longest time [s] until server, gatekeeper, gate and robot have ended."""


def end_time(server, how):
    """Time [s] from the end to that of the last process."""
    family = server.family()
    assert len(family) == 4
    started = time.monotonic()
    server.end(how)
    while running(family) and time.monotonic() - started < 10.0:
        time.sleep(0.01)
    assert not server.family().keys() - family.keys()
    return time.monotonic() - started


def outcomes(runs):
    return [json.loads(path.read_bytes())["outcome"] for path in runs.glob("*/episode.json")]


@pytest.mark.parametrize(
    ("kind", "how"),
    [
        (StdioServer, "closed input"),
        pytest.param(StdioServer, "SIGTERM", marks=pytest.mark.slow),
        pytest.param(StdioServer, "SIGKILL", marks=pytest.mark.slow),
        (HttpServer, "SIGTERM"),
        (HttpServer, "SIGKILL"),
    ],
)
def test_all_processes_end_with_the_server_during_a_motion(kind, how, environment, tmp_path):  # noqa: F811
    runs = tmp_path / "runs"
    server = kind(environment, "--runs", str(runs))
    try:
        server.begin_motion()
        assert end_time(server, how) < END_TIME
    finally:
        server.close()
    expected = [] if how == "SIGKILL" else [("aborted", CLOSED)]
    ended = outcomes(runs)
    assert [(one["kind"], one["reason"]) for one in ended] == expected
    assert all(one["h_min"] > 0.0 and one["actions"][0]["status"] == "stopped" for one in ended)


@pytest.mark.slow
@pytest.mark.parametrize("how", ["SIGTERM", "SIGKILL"])
def test_all_processes_end_with_the_server_at_rest(how, environment):  # noqa: F811
    server = HttpServer(environment)
    try:
        assert end_time(server, how) < END_TIME
    finally:
        server.close()


@pytest.mark.parametrize("module", ["gatekeeper.process", "simulated_robot"])
def test_a_process_that_hangs_is_killed_in_time(module, environment):  # noqa: F811
    server = HttpServer(environment)
    try:
        hangs = next(
            pid for pid in server.family() if f"{module}\0".encode() in Path(f"/proc/{pid}/cmdline").read_bytes()
        )
        os.kill(hangs, signal.SIGSTOP)
        assert end_time(server, "SIGTERM") < END_TIME
    finally:
        server.close()
