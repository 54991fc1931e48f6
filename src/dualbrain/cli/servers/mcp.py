"""dualbrain mcp: a robot as tools of any MCP client."""

from __future__ import annotations

from dualbrain.cli.common.console import print_message
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.servers.http_options import DEFAULT_HTTP, HttpOptions
from dualbrain.cli.servers.http_service import serve_robot
from dualbrain.cli.servers.robot_options import DEFAULT_ROBOT, RobotOptions, open_robot
from dualbrain.cli.servers.server_end import ServerEnd
from dualbrain.core.processes.process_end import end_process


def mcp(*, http: int = 0, robot: RobotOptions = DEFAULT_ROBOT, server: HttpOptions = DEFAULT_HTTP) -> int:
    """Serve a robot to agents over the Model Context Protocol (MCP), on stdin and stdout or over HTTP.

    Parameters
    ----------
    http
        Port of Streamable HTTP. Default: stdin and stdout, as MCP clients start a server.
    """
    from dualbrain.agent_server.mcp_server import make_mcp_server

    if http:
        return serve_robot("dualbrain mcp", http, robot, server)
    from dualbrain.agent_server.stdio_server import StandardStreams, serve_stdio
    from dualbrain.errors import UsageError

    if server != DEFAULT_HTTP:
        raise UsageError.stating(
            "--host, --token-file, --tls-cert and --tls-key belong to --http.", fix="Add --http PORT, or remove them."
        )
    streams = StandardStreams()  # before the gatekeeper starts, which inherits standard output
    with open_robot(robot) as opened:
        print_message(f"dualbrain mcp: the robot {opened.name} is ready.")
        serve_stdio(make_mcp_server(opened), streams, on_end=ServerEnd(opened).begin)
    return end_process(ExitCode.SUCCESS)
