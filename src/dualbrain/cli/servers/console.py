"""dualbrain console: a page in the browser that shows a robot, its runs and its memory, and stops it."""

from __future__ import annotations

from dualbrain.cli.servers.http_options import DEFAULT_HTTP, HttpOptions
from dualbrain.cli.servers.http_service import serve_robot
from dualbrain.cli.servers.robot_options import DEFAULT_ROBOT, RobotOptions

DEFAULT_PORT = 8765


def console(
    *, port: int = DEFAULT_PORT, robot: RobotOptions = DEFAULT_ROBOT, server: HttpOptions = DEFAULT_HTTP
) -> int:
    """Show a robot in the browser: events, contract editor, runs, memory, and stops.

    Parameters
    ----------
    port
        Port of the page, on the loopback interface. Agents reach the same robot over MCP at this port.
    """
    return serve_robot("dualbrain console", port, robot, server)
