"""Rename every variable, parameter, attribute and property of one name whose inferred type mentions a given class.

python tools/rename/rename_typed.py NAME TYPE NEW [--skip GLOB ...]
"""

from __future__ import annotations

import argparse
import ast
import sys
from fnmatch import fnmatch
from pathlib import Path
from urllib.parse import unquote

sys.path.insert(0, str(Path(__file__).resolve().parent))
from rename_symbols import ROOT, Server, write


def places(tree: ast.Module, name: str) -> list[tuple[int, int]]:
    """Line and byte column, from 0, of every definition of `name`."""
    found: list[tuple[int, int]] = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Name) and node.id == name and isinstance(node.ctx, ast.Store):
            found.append((node.lineno - 1, node.col_offset))
        elif isinstance(node, ast.arg) and node.arg == name:
            found.append((node.lineno - 1, node.col_offset))
        elif isinstance(node, ast.Attribute) and node.attr == name and isinstance(node.ctx, ast.Store):
            found.append((node.end_lineno - 1, node.end_col_offset - len(name.encode())))
        elif isinstance(node, ast.FunctionDef) and node.name == name:
            found.append((node.lineno - 1, node.col_offset + len("def ")))
    return found


def main() -> int:
    """Hover over each definition, and rename where the type fits."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("name")
    parser.add_argument("type")
    parser.add_argument("new")
    parser.add_argument("--skip", nargs="*", default=[])
    parser.add_argument("--untyped-tests", action="store_true", help="also untyped definitions below tests/")
    asked = parser.parse_args()
    server = Server([".venv/bin/basedpyright-langserver", "--stdio"])
    edits: dict[Path, dict[tuple[int, int, int], str]] = {}
    first = True
    for top in ("src", "tests", "experiments", "benchmarks", "tools", "examples"):
        for path in sorted((ROOT / top).rglob("*.py")):
            relative = str(path.relative_to(ROOT))
            if relative.startswith("tools/rename") or any(fnmatch(relative, one) for one in asked.skip):
                continue
            text = path.read_text()
            if asked.name not in text:
                continue
            here = places(ast.parse(text), asked.name)
            if not here:
                continue
            document = {"uri": path.as_uri(), "languageId": "python", "version": 1, "text": text}
            server.send({"jsonrpc": "2.0", "method": "textDocument/didOpen", "params": {"textDocument": document}})
            if first:
                server.request("textDocument/documentSymbol", {"textDocument": {"uri": path.as_uri()}})
                first = False
            lines = text.splitlines()
            for line, column in here:
                column = len(lines[line].encode()[:column].decode())
                where = {"textDocument": {"uri": path.as_uri()}, "position": {"line": line, "character": column}}
                hover = str(server.request("textDocument/hover", where))
                untyped = relative.startswith("tests") and asked.untyped_tests and hover.rstrip("'}").split("```")[0]
                if asked.type not in hover and not untyped:
                    continue
                result = server.request("textDocument/rename", where | {"newName": asked.new}) or {}
                for change in result.get("documentChanges", []):
                    file = Path(unquote(change["textDocument"]["uri"].removeprefix("file://")))
                    for edit in change["edits"]:
                        start, end = edit["range"]["start"], edit["range"]["end"]
                        edits.setdefault(file, {})[start["line"], start["character"], end["character"]] = edit[
                            "newText"
                        ]
            server.send(
                {
                    "jsonrpc": "2.0",
                    "method": "textDocument/didClose",
                    "params": {"textDocument": {"uri": path.as_uri()}},
                }
            )
    write(edits)
    sys.stdout.write(f"{sum(map(len, edits.values()))} edits in {len(edits)} files\n")
    server.process.terminate()
    return 0


if __name__ == "__main__":
    sys.exit(main())
