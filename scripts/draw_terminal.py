"""Draw a terminal in which an agent uses a robot, as docs/images/console/terminal.png.

`python -m scripts.draw_terminal docs/images/console` starts `dualbrain mcp` over HTTP, calls its tools as
`examples/agents/over_http.py` does, and takes an image of commands and output with headless Chromium.
"""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any

from rich.console import Console
from rich.terminal_theme import MONOKAI

from examples.agents.over_http import call_tool
from scripts.draw_live_view import save_image
from tests.visualization.headless_browser import Browser

PORT, TOKEN = 8765, "token-of-this-image-only"
COLUMNS, SIZE = 120, (1010, 690)
STYLE = "body { margin: 0; background: #0c0c0c; } pre { margin: 16px; color: #d8d8d8; font: 13px/1.5 monospace; }"


def main(folder: Path) -> None:
    """Write the image."""
    folder.mkdir(parents=True, exist_ok=True)
    console = Console(record=True, width=COLUMNS, file=io.StringIO(), force_terminal=True)
    with tempfile.TemporaryDirectory() as home:
        console.print("[bold green]$[/] dualbrain mcp --scene 8 --http 8765")
        environment = os.environ | {"DUALBRAIN_HOME": home, "DUALBRAIN_TOKEN": TOKEN}
        command = [sys.executable, "-m", "dualbrain", "mcp", "--scene", "8", "--http", str(PORT)]
        server = subprocess.Popen(command, env=environment, stderr=subprocess.PIPE, text=True)
        assert server.stderr is not None
        try:
            console.print(server.stderr.readline().strip(), markup=False)
            use_robot(console)
        finally:
            server.terminate()
            server.communicate()
        page = Path(home) / "terminal.html"
        text = console.export_html(theme=MONOKAI, inline_styles=True, code_format="<pre>{code}</pre>")
        page.write_text(f"<style>{STYLE}</style>{text}", encoding="utf-8")
        with Browser(Path(home), SIZE) as browser:
            browser.open(page.as_uri())
            save_image(browser, folder / "terminal.png")


def use_robot(console: Console) -> None:
    """Show a rejection, an execution, and a repeated submission."""
    scene = call(console, "get_scene", {}, show=("summary", "next_id"))
    context = {"robot": scene["robot"], "registry": scene["registry"]}
    contract = {"id": scene["next_id"], "context": context, "action_sequence": [{"skill": "throw", "params": {}}]}
    call(console, "check_contract", {"contract": contract})
    contract["action_sequence"] = [{"skill": "hold", "params": {"duration": 1.0}}]
    call(console, "submit_contract", {"contract": contract}, show=("state", "outcome"))
    call(console, "submit_contract", {"contract": contract}, show=("state", "repeated", "note"))


def call(console: Console, name: str, arguments: dict[str, Any], show: tuple[str, ...] = ()) -> dict[str, Any]:
    """Call a tool, and print the call and the fields `show` of its result (none: all)."""
    result = call_tool(f"http://127.0.0.1:{PORT}/mcp", TOKEN, name, arguments)
    actions = [one["skill"] for one in arguments.get("contract", {}).get("action_sequence", ())]
    console.print(f"\n[bold green]>>>[/] {name}({', '.join(actions)})")
    shown = {key: value for key, value in result.items() if key in show or not show}
    console.print(
        shown.get("summary") or json.dumps(shown, ensure_ascii=False), markup=False, highlight="summary" not in shown
    )
    return result


if __name__ == "__main__":
    main(Path(sys.argv[1]))
