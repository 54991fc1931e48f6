"""dualbrain console and dualbrain mcp --http serve the same robot to people and agents, and print no token to a log."""

from contextlib import nullcontext

import pytest

from dualbrain.agent_server import http_server
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.servers import http_service, server_end
from tests.agent_server.console.console_server import TOKEN, FakeRobot


class Closable(FakeRobot):
    closed = False

    def begin_close(self):
        self.closed = True

    def kill(self):
        pass


@pytest.fixture
def served(monkeypatch):
    """The arguments with which the command serves; the server reports that it is ready, and ends."""
    robot, found = Closable(), {}

    def serve(server, config, listener, routes, *, is_public, overview, on_ready, on_stop):
        found.update(overview=overview, robot=robot, config=config, routes=routes, is_public=is_public)
        on_ready()
        on_stop()

    monkeypatch.setattr(http_service, "end_process", lambda code: code)
    monkeypatch.setattr(server_end.EndDeadline, "start", lambda self: None)
    monkeypatch.setattr(http_service, "open_robot", lambda options: nullcontext(robot))
    monkeypatch.setattr(http_server, "serve_http", serve)
    monkeypatch.setattr(http_server.HttpConfig, "open_listener", lambda self: nullcontext())
    monkeypatch.setenv("DUALBRAIN_TOKEN", TOKEN)
    return found


@pytest.mark.parametrize("command", [("console", "--port", "8700"), ("mcp", "--http", "8700")], ids=["console", "mcp"])
def test_both_commands_serve_agents_and_people_at_one_port(command, run_command, served):
    code, out, err = run_command(*command)
    assert (code, out) == (ExitCode.SUCCESS, "")
    assert "is ready at http://127.0.0.1:8700/mcp (token: DUALBRAIN_TOKEN)" in err
    assert "Console: http://127.0.0.1:8700/console\n" in err
    assert TOKEN not in err
    assert {"/console", "/console/api/stop"} <= {route.path for route in served["routes"]}
    assert served["overview"] == "The endpoint of MCP is /mcp, and the console for people is /console."
    assert served["is_public"]("/console")
    assert not served["is_public"]("/mcp")
    assert served["robot"].closed


def test_a_terminal_gets_an_address_with_the_token_in_its_fragment(run_command, served, monkeypatch):
    monkeypatch.setattr("sys.stderr.isatty", lambda: True)
    _, _, err = run_command("console")
    assert f"Console: http://127.0.0.1:8765/console#token={TOKEN}\n" in err
    assert served["config"].token == TOKEN


def test_a_console_for_other_machines_needs_tls(run_command, served):
    code, _, err = run_command("console", "--host", "192.0.2.1")
    assert code == ExitCode.SETUP
    assert "without TLS" in err
    assert not served
