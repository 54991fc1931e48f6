"""Rename symbols over the whole repository with the type checker's own notion of what refers to what.

    python tools/rename/rename_symbols.py --modules FILES.txt [--modules ...] SYMBOLS.toml [...]

A symbol table holds entries ``[[symbol]] module, name, new``; `name` is "Name", "Class.member", "function(parameter)"
or "Class.method(parameter)". `module` may be the name before the files moved (looked up in FILES.txt) or after. All
renames are computed on one state of the tree by `basedpyright-langserver` and written together.
"""

from __future__ import annotations

import argparse
import ast
import json
import re
import subprocess
import sys
import threading
import tomllib
from pathlib import Path
from typing import Any
from urllib.parse import unquote

ROOT = Path.cwd().resolve()


class Server:
    """A language server on standard input and output."""

    def __init__(self, command: list[str]) -> None:
        """Start it for the current folder."""
        self.process = subprocess.Popen(
            command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, cwd=ROOT
        )
        self.count, self.replies, self.arrived = 0, dict[int, Any](), threading.Condition()
        threading.Thread(target=self._read, daemon=True).start()
        uri = ROOT.as_uri()
        self.request(
            "initialize",
            {
                "processId": None,
                "rootUri": uri,
                "workspaceFolders": [{"uri": uri, "name": "root"}],
                "capabilities": {"workspace": {"configuration": True, "workspaceEdit": {"documentChanges": True}}},
            },
        )
        self.send({"jsonrpc": "2.0", "method": "initialized", "params": {}})

    def send(self, message: dict[str, Any]) -> None:
        """Send one message."""
        data = json.dumps(message).encode()
        assert self.process.stdin
        self.process.stdin.write(b"Content-Length: %d\r\n\r\n" % len(data) + data)
        self.process.stdin.flush()

    def request(self, method: str, params: dict[str, Any], timeout: float = 300.0) -> Any:
        """Ask, and wait for the reply; raises `RuntimeError` on an error reply."""
        self.count += 1
        number = self.count
        self.send({"jsonrpc": "2.0", "id": number, "method": method, "params": params})
        with self.arrived:
            if not self.arrived.wait_for(lambda: number in self.replies, timeout):
                raise TimeoutError(method)
            reply = self.replies.pop(number)
        if "error" in reply:
            raise RuntimeError(reply["error"])
        return reply["result"]

    def _read(self) -> None:
        stream = self.process.stdout
        assert stream
        while True:
            length = 0
            while line := stream.readline().strip():
                if line.lower().startswith(b"content-length"):
                    length = int(line.split(b":")[1])
            if not length:
                return
            message = json.loads(stream.read(length))
            if "method" in message and "id" in message:
                asked = message["params"].get("items", []) if message["method"] == "workspace/configuration" else None
                result = None if asked is None else [{} for _ in asked]
                self.send({"jsonrpc": "2.0", "id": message["id"], "result": result})
            elif "id" in message:
                with self.arrived:
                    self.replies[message["id"]] = message
                    self.arrived.notify_all()


def find(tree: ast.Module, name: str) -> tuple[int, int] | None:
    """Line and byte column (both from 0) of the definition of `name`; None if there is none."""
    path, _, parameter = name.partition("(")
    body: list[ast.stmt] = tree.body
    parts = path.split(".")
    node: ast.AST | None = None
    for part in parts[:-1]:
        node = next((one for one in body if isinstance(one, ast.ClassDef) and one.name == part), None)
        if not isinstance(node, ast.ClassDef):
            return None
        body = node.body
    defined = _definition(body, parts[-1])
    if parameter:
        if not isinstance(defined, (ast.FunctionDef, ast.AsyncFunctionDef)):
            return None
        arguments = defined.args
        for one in [*arguments.posonlyargs, *arguments.args, *arguments.kwonlyargs, arguments.vararg, arguments.kwarg]:
            if one is not None and one.arg == parameter.rstrip(")"):
                return one.lineno - 1, one.col_offset
        return None
    if isinstance(defined, (ast.FunctionDef, ast.AsyncFunctionDef)):
        keyword = "async def " if isinstance(defined, ast.AsyncFunctionDef) else "def "
        return defined.lineno - 1, defined.col_offset + len(keyword)
    if isinstance(defined, ast.ClassDef):
        return defined.lineno - 1, defined.col_offset + len("class ")
    if isinstance(defined, ast.Name):
        return defined.lineno - 1, defined.col_offset
    if isinstance(node, ast.ClassDef):
        for one in ast.walk(node):
            held = isinstance(one, ast.Attribute) and isinstance(one.value, ast.Name) and one.value.id == "self"
            if held and one.attr == parts[-1] and isinstance(one.ctx, ast.Store):
                return one.end_lineno - 1, one.end_col_offset - len(one.attr.encode())
    return None


def _definition(body: list[ast.stmt], name: str) -> ast.AST | None:
    for one in body:
        if isinstance(one, (ast.FunctionDef, ast.AsyncFunctionDef, ast.ClassDef)) and one.name == name:
            return one
        targets = one.targets if isinstance(one, ast.Assign) else [one.target] if isinstance(one, ast.AnnAssign) else []
        if hasattr(ast, "TypeAlias") and isinstance(one, getattr(ast, "TypeAlias", ())):
            targets = [one.name]
        for target in targets:
            for part in ast.walk(target):
                if isinstance(part, ast.Name) and part.id == name:
                    return part
        if isinstance(one, (ast.If, ast.Try, ast.With)):
            inner = _definition([*one.body, *getattr(one, "orelse", [])], name)
            if inner is not None:
                return inner
    return None


def modules_of(tables: list[Path]) -> dict[str, Path]:
    """Files by module name, before and after the move."""
    found: dict[str, Path] = {}
    for top in ("src", "tests", "benchmarks", "experiments", "tools", "."):
        for path in (ROOT / top).glob("*.py" if top == "." else "**/*.py"):
            name = ".".join(path.relative_to(ROOT / top if top == "src" else ROOT).with_suffix("").parts)
            found[name.removesuffix(".__init__")] = path
            if top == "benchmarks":
                short = ".".join(path.relative_to(ROOT / top).with_suffix("").parts)
                found.setdefault(short, path)
    for table in tables:
        for line in table.read_text().splitlines():
            hit = re.match(r"^(\S+)\.py [=>] (\S+\.py)", line)
            if hit and not line.startswith("#") and (ROOT / hit[2]).exists():
                old = hit[1].removeprefix("src/").removeprefix("benchmarks/").replace("/", ".")
                found[old.removesuffix(".__init__")] = ROOT / hit[2]
    return found


def write(edits: dict[Path, dict[tuple[int, int, int], str]]) -> None:
    """Replace every range by its new text."""
    for file, changes in edits.items():
        lines = file.read_text().splitlines(keepends=True)
        for (line, begin, end), new in sorted(changes.items(), reverse=True):
            lines[line] = lines[line][:begin] + new + lines[line][end:]
        file.write_text("".join(lines))


def apply_dumps(paths: list[Path]) -> int:
    """Apply the edits of several dumps that were computed on this state of the tree; 1 if two of them disagree."""
    edits: dict[Path, dict[tuple[int, int, int], str]] = {}
    clashes = 0
    for path in paths:
        for file, line, begin, end, new in json.loads(path.read_text()):
            before = edits.setdefault(ROOT / file, {}).setdefault((line, begin, end), new)
            if before != new:
                clashes += 1
                sys.stdout.write(f"{file}:{line + 1}: {before} or {new}\n")
    write(edits)
    sys.stdout.write(f"{sum(map(len, edits.values()))} edits in {len(edits)} files, {clashes} clashes\n")
    return 1 if clashes else 0


def main() -> int:  # noqa: C901, PLR0912, PLR0915  (one pass, told step by step)
    """Compute all renames, then write them."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--modules", type=Path, action="append", default=[])
    parser.add_argument("--server", default=".venv/bin/basedpyright-langserver")
    parser.add_argument("--dry-run", action="store_true")
    parser.add_argument("--dump", type=Path, help="write the edits as JSON instead of applying them")
    parser.add_argument("--apply", type=Path, nargs="*", help="apply dumped edits")
    parser.add_argument("tables", type=Path, nargs="*")
    asked = parser.parse_args()
    if asked.apply:
        return apply_dumps(asked.apply)
    modules = modules_of(asked.modules)
    entries = [one for table in asked.tables for one in tomllib.loads(table.read_text()).get("symbol", [])]
    server = Server([asked.server, "--stdio"])
    edits: dict[Path, dict[tuple[int, int, int], str]] = {}
    failed: list[str] = []
    trees: dict[Path, tuple[str, ast.Module]] = {}
    for count, entry in enumerate(entries, start=1):
        label = f"{entry['module']}:{entry['name']}"
        path = modules.get(entry["module"])
        if path is None:
            failed.append(f"{label}: no such module")
            continue
        if path not in trees:
            text = path.read_text()
            trees[path] = text, ast.parse(text)
            document = {"uri": path.as_uri(), "languageId": "python", "version": 1, "text": text}
            server.send({"jsonrpc": "2.0", "method": "textDocument/didOpen", "params": {"textDocument": document}})
            if len(trees) == 1:
                server.request("textDocument/documentSymbol", {"textDocument": {"uri": path.as_uri()}})
        text, tree = trees[path]
        place = find(tree, entry["name"])
        if place is None:
            failed.append(f"{label}: not found in {path.relative_to(ROOT)}")
            continue
        line, column = place
        column = len(text.splitlines()[line].encode()[:column].decode())
        where = {"textDocument": {"uri": path.as_uri()}, "position": {"line": line, "character": column}}
        try:
            result = server.request("textDocument/rename", where | {"newName": entry["new"]})
            if count == 1:  # the first request may come before all files are known
                result = server.request("textDocument/rename", where | {"newName": entry["new"]})
        except (RuntimeError, TimeoutError) as error:
            failed.append(f"{label}: {error}")
            continue
        changes = (result or {}).get("documentChanges", [])
        if not changes:
            failed.append(f"{label}: the server renames nothing")
        for change in changes:
            file = Path(unquote(change["textDocument"]["uri"].removeprefix("file://")))
            for edit in change["edits"]:
                start, end = edit["range"]["start"], edit["range"]["end"]
                key = start["line"], start["character"], end["character"]
                before = edits.setdefault(file, {}).get(key)
                if before is not None and before != edit["newText"]:
                    failed.append(
                        f"{label}: {file.relative_to(ROOT)}:{key[0] + 1} would be {before} and {edit['newText']}"
                    )
                edits[file][key] = edit["newText"]
        if count % 50 == 0:
            sys.stderr.write(f"{count}/{len(entries)}\n")
    if asked.dump:
        rows = [[str(file.relative_to(ROOT)), *key, new] for file, found in edits.items() for key, new in found.items()]
        asked.dump.write_text(json.dumps(rows))
    elif not asked.dry_run:
        write(edits)
    sys.stdout.write("\n".join([*failed, f"{len(entries)} symbols, {len(edits)} files, {len(failed)} remarks"]) + "\n")
    server.process.terminate()
    return 0


if __name__ == "__main__":
    sys.exit(main())
