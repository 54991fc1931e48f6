"""A robot over plain HTTP, without any SDK: one POST per call of the Model Context Protocol.

`pip install httpx`. Run `dualbrain mcp --scene 8 --http 8765`, which prints the FILE that holds its token, and then
`DUALBRAIN_TOKEN=$(cat FILE) python examples/agents/over_http.py`.
"""

from __future__ import annotations

import os
from typing import Any

import httpx

VERSION, PREFIX = "2026-07-28", "io.modelcontextprotocol/"
META = {f"{PREFIX}protocolVersion": VERSION, f"{PREFIX}clientInfo": {"name": "over_http", "version": "1"}}


def call_tool(url: str, token: str, name: str, arguments: dict[str, Any]) -> dict[str, Any]:
    """The result of one tool of the robot; raises an error if the server refuses the request."""
    headers = {"Authorization": f"Bearer {token}", "Accept": "application/json, text/event-stream"}
    headers |= {"MCP-Protocol-Version": VERSION, "Mcp-Method": "tools/call", "Mcp-Name": name}
    parameters = {"name": name, "arguments": arguments, "_meta": META | {f"{PREFIX}clientCapabilities": {}}}
    body = {"jsonrpc": "2.0", "id": 1, "method": "tools/call", "params": parameters}
    reply = httpx.post(url, headers=headers, json=body, timeout=90)
    return reply.raise_for_status().json()["result"]["structuredContent"]


def main(url: str, token: str) -> None:
    """Hold still for a second."""
    scene = call_tool(url, token, "get_scene", {})
    contract = {"id": scene["next_id"], "context": {"robot": scene["robot"], "registry": scene["registry"]}}
    contract["action_sequence"] = [{"skill": "hold", "params": {"duration": 1.0}}]
    print(call_tool(url, token, "submit_contract", {"contract": contract}))


if __name__ == "__main__":
    if "DUALBRAIN_TOKEN" not in os.environ:
        raise SystemExit("Set DUALBRAIN_TOKEN to the token of the server; it prints the file of its token at start.")
    main("http://127.0.0.1:8765/mcp", os.environ["DUALBRAIN_TOKEN"])
