"""Time of a contract check through the MCP server, beyond the time of the gate itself.

One client checks the same contract again and again, over HTTP and over the gatekeeper's socket in turn, while the robot
is at rest. The gatekeeper reports the time of its gate with each verdict.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from statistics import median
from typing import Any

import anyio
import httpx2
import msgspec
from mcp.client.client import Client
from mcp.client.streamable_http import streamable_http_client

from dualbrain import Robot
from dualbrain.agent_server.access_control import AccessControl, AccessPolicy
from dualbrain.agent_server.mcp_server import make_mcp_server
from dualbrain.control import GatekeeperClient
from experiments.engine.experiment import Options, Row, WorkUnit
from experiments.figures.tables import markdown_table

CALLS = 500
PORT, TOKEN = 8765, "t" * 32
LIMIT_MS = 5.0


class CheckCost:
    """Paired times of checks."""

    name = "check_cost"
    claim = f"`check_contract` costs less than {LIMIT_MS:g} ms beyond the gate on an idle machine."
    intervals = "Quantiles over the calls of one run."

    def units(self, options: Options) -> list[WorkUnit]:
        """One run."""
        del options
        return [WorkUnit("run", {"calls": CALLS})]

    def run(self, parameters: dict[str, Any]) -> Row:
        """Check in turn over both paths."""
        with Robot.simulated("panda", 8) as robot:
            return {"times": anyio.run(_measure, robot, parameters["calls"])}

    def summarize_row(self, row: Row) -> str:
        """The medians."""
        return ", ".join(f"{name} {median(times):.2f} ms" for name, times in row["times"].items())

    def report(self, rows: list[Row]) -> list[str]:
        """A table of quantiles."""
        head = ("path", "median", "95 %", "longest")
        return [line for row in rows for line in markdown_table(head, _table_rows(row["times"]))]


def _table_rows(times: dict[str, list[float]]) -> Iterator[tuple[str, ...]]:
    for name, values in times.items():
        ordered = sorted(values)
        p95 = ordered[int(0.95 * len(ordered))]
        yield (name, f"{median(ordered):.2f} ms", f"{p95:.2f} ms", f"{ordered[-1]:.2f} ms")


async def _measure(robot: Robot, calls: int) -> dict[str, list[float]]:
    app = make_mcp_server(robot).streamable_http_app()
    protected = AccessControl(app, AccessPolicy(token=TOKEN, hosts=("127.0.0.1",), port=PORT))
    headers = {"Authorization": f"Bearer {TOKEN}"}
    http = httpx2.AsyncClient(transport=httpx2.ASGITransport(protected), headers=headers, timeout=30.0)
    contract = robot.contract([{"skill": "hold", "params": {"duration": 1.0}}])
    gate, socket, mcp = list[float](), list[float](), list[float]()
    link: GatekeeperClient = robot._connection.client  # pyright: ignore[reportPrivateUsage]
    async with app.router.lifespan_context(app), http:
        transport = streamable_http_client(f"http://127.0.0.1:{PORT}/mcp", http_client=http)
        async with Client(transport) as client:
            for _ in range(calls):
                start = time.perf_counter()
                report = link.check(msgspec.json.encode(contract))
                gate.append(1e3 * report.gate_s)
                socket.append(1e3 * (time.perf_counter() - start) - gate[-1])
                start = time.perf_counter()
                await client.call_tool("check_contract", {"contract": contract})
                mcp.append(1e3 * (time.perf_counter() - start) - gate[-1])
    return {"the gate": gate, "the gatekeeper's socket, beyond the gate": socket, "MCP, beyond the gate": mcp}
