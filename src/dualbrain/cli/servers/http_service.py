"""One HTTP server for a robot: MCP for agents and the console for people."""

from __future__ import annotations

import sys
from pathlib import Path

from dualbrain.cli.common.console import print_message
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.servers.http_options import HttpOptions, http_config
from dualbrain.cli.servers.robot_options import RobotOptions, open_robot
from dualbrain.cli.servers.server_end import ServerEnd
from dualbrain.core.paths import dualbrain_home
from dualbrain.core.processes.process_end import end_process

RUNS_FOLDER = Path("runs")
"""Folder whose runs the console shows, if none is named: that of `dualbrain run`."""


def serve_robot(command: str, port: int, robot: RobotOptions, server: HttpOptions) -> int:
    """Open the robot and serve it at `port` until a signal, which ends the process; `command` is for messages."""
    from dualbrain.agent_server.access_control import MCP_PATH
    from dualbrain.agent_server.console.routes import CONSOLE_PATH, console_routes, is_public
    from dualbrain.agent_server.http_server import serve_http
    from dualbrain.agent_server.mcp_server import make_mcp_server

    config = http_config(server, port)
    with config.open_listener() as listener, open_robot(robot) as opened:
        ledger = robot.ledger or dualbrain_home() / "ledger.sqlite"
        end = ServerEnd(opened)
        routes = console_routes(opened, runs=robot.runs or RUNS_FOLDER, ledger=ledger, has_ended=lambda: end.has_begun)

        def report() -> None:
            where = f"{config.url}{MCP_PATH} (token: {server.token_place})"
            print_message(f"{command}: the robot {opened.name} is ready at {where}. Ctrl-C ends it.")
            secret = f"#token={config.token}" if sys.stderr.isatty() else ""  # a log keeps no token
            print_message(f"Console: {config.url}{CONSOLE_PATH}{secret}")

        mcp_server = make_mcp_server(opened)
        serve_http(
            mcp_server,
            config,
            listener,
            routes,
            is_public=is_public,
            overview=f"The endpoint of MCP is {MCP_PATH}, and the console for people is {CONSOLE_PATH}.",
            on_ready=report,
            on_stop=end.begin,
        )
    return end_process(ExitCode.SUCCESS)
