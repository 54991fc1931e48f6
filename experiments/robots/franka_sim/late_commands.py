"""Start the simulator so that it drops a command which arrives after its period, as the arm does.

The simulator counts such a command as lost, and then applies it, although the robot drops it, as its source states.
The next command, which the filter has continued from the executed one, is then judged against the late one. Runs with
the Python of the simulator's environment.
"""

from __future__ import annotations

from typing import Any

from franka_sim.franka_sim_server import FrankaSimServer  # pyright: ignore[reportMissingImports]
from franka_sim.run_server import main  # pyright: ignore[reportMissingImports]

Server: Any = FrankaSimServer
absorb = Server._absorb_within_motion_limits


def absorb_in_time(server: Any, command: dict[str, Any], *, fresh: bool) -> bool:
    """As the simulator's own method, for a command that answers the newest state; False: it is not applied."""
    return fresh and absorb(server, command, fresh=True)


if __name__ == "__main__":
    Server._absorb_within_motion_limits = absorb_in_time
    main()
