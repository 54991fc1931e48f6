"""dualbrain mcp: a robot as tools of any MCP client."""

from __future__ import annotations

import sys

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.servers.http_options import DEFAULT_HTTP, HttpOptions, http_config
from dualbrain.cli.servers.robot_options import DEFAULT_ROBOT, RobotOptions, open_robot


def mcp(*, http: int = 0, robot: RobotOptions = DEFAULT_ROBOT, server: HttpOptions = DEFAULT_HTTP) -> int:
    """Serve a robot to agents over the Model Context Protocol (MCP), on stdin and stdout or over HTTP.

    Parameters
    ----------
    http
        Port of Streamable HTTP. Default: stdin and stdout, as MCP clients start a server.
    """
    from dualbrain.agent_server.mcp_server import make_mcp_server

    if http:
        return _serve_http(http, robot, server)
    from dualbrain.agent_server.stdio_server import StandardStreams, serve_stdio

    streams = StandardStreams()  # before the gatekeeper starts, which inherits standard output
    with open_robot(robot) as opened:
        print(f"dualbrain mcp: the robot {opened.name} is ready.", file=sys.stderr)
        serve_stdio(make_mcp_server(opened), streams)
    return ExitCode.SUCCESS


def _serve_http(port: int, robot: RobotOptions, server: HttpOptions) -> int:
    from dualbrain.agent_server.http_server import MCP_PATH, serve_http
    from dualbrain.agent_server.mcp_server import make_mcp_server

    config = http_config(server, port)
    with open_robot(robot) as opened:
        ready = f"dualbrain mcp: the robot {opened.name} is ready at {config.url}{MCP_PATH}; the token is in "
        ready += f"{server.token_place}. Ctrl-C ends it."
        serve_http(
            make_mcp_server(opened),
            config,
            on_ready=lambda: print(ready, file=sys.stderr),
            on_stop=opened.close,
        )
    return ExitCode.SUCCESS
