"""The steps that every client and transport must pass: read from `scenario.json`, also by the client in JavaScript."""

from __future__ import annotations

import json
from pathlib import Path

from mcp.client.client import Client
from mcp.shared.exceptions import MCPError

FILE = Path(__file__).with_name("scenario.json")


def steps(scene: dict) -> list[dict]:
    """The steps, with the id and the registry of the present scene."""
    text = FILE.read_text(encoding="utf-8").replace("$id", scene["next_id"]).replace("$registry", scene["registry"])
    return json.loads(text)


async def run_steps(client: Client) -> list[tuple[dict, dict]]:
    """Each step with its result: `value` and `is_error`, or the `error_code`."""
    scene = (await client.call_tool("get_scene", {})).structured_content
    results = []
    for one in steps(scene):
        try:
            results.append((one, await _run(client, one)))
        except MCPError as error:
            results.append((one, {"error_code": error.code, "message": error.message}))
    return results


async def _run(client: Client, one: dict) -> dict:
    progress: list[float] = []

    async def on_progress(done: float, total: float | None, message: str | None) -> None:
        progress.append(done)

    match one["do"]:
        case "list_tools":
            return {"value": [tool.name for tool in (await client.list_tools()).tools]}
        case "call":
            callback = on_progress if one.get("progress") else None
            found = await client.call_tool(one["tool"], one["arguments"], progress_callback=callback)
            return {"value": found.structured_content, "is_error": found.is_error, "progress": len(progress)}
        case "read":
            return {"value": json.loads((await client.read_resource(one["uri"])).contents[0].text)}
        case _:
            found = await client.get_prompt(one["name"], one["arguments"])
            return {"value": found.messages[0].content.text}


def check_results(results: list[tuple[dict, dict]]) -> None:
    """Fail unless every result is that of its step."""
    for one, result in results:
        if "error_code" in one:
            assert result.get("error_code") == one["error_code"], (one, result)
            continue
        assert "error_code" not in result, (one, result)
        assert result.get("is_error", False) == one.get("is_error", False), (one, result)
        value = result["value"]
        if "contains" in one:
            assert one["contains"] in value
        elif isinstance(one["expect"], list):
            assert value == one["expect"]
        else:
            assert {name: value.get(name) for name in one["expect"]} == one["expect"], (one, result)
        if one.get("progress"):
            assert result["progress"] > 0
