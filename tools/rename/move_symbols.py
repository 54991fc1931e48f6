"""Rewrite imports of symbols that moved from one module to another.

python tools/rename/move_symbols.py TABLE     # lines ``package.old:Name = package.new``
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path


def main() -> int:
    """Rewrite `from old import Name` and the dotted string `old.Name` in every tracked Python file."""
    moves: dict[tuple[str, str], str] = {}
    for line in Path(sys.argv[1]).read_text().splitlines():
        found = re.match(r"^([\w.]+):(\w+) = ([\w.]+)", line)
        if found:
            moves[found[1], found[2]] = found[3]
    files = subprocess.run(
        ["git", "ls-files", "*.py", "*.md"], check=True, capture_output=True, text=True
    ).stdout.split()
    for file in files:
        path = Path(file)
        if not path.exists() or file.startswith("tools/rename/"):
            continue
        text = path.read_text()
        for (old, name), new in moves.items():
            text = re.sub(rf"\b{re.escape(old)}\.{name}\b", f"{new}.{name}", text)
        if file.endswith(".py"):
            own = file.removeprefix("src/").removesuffix(".py").replace("/", ".")
            text = rewrite(text, moves, own)
        else:
            text = re.sub(r"(?m)^from [\w.]+ import .*$", lambda m: rewrite(m[0], moves, "").rstrip("\n"), text)
        path.write_text(text)
    return 0


def rewrite(text: str, moves: dict[tuple[str, str], str], own: str) -> str:
    """`text` with every import of a moved symbol rewritten."""
    try:
        tree = ast.parse(text)
    except SyntaxError:
        return text
    starts = [0]
    for line in text.splitlines(keepends=True):
        starts.append(starts[-1] + len(line.encode()))
    data, edits = text.encode(), []
    for node in ast.walk(tree):
        if not isinstance(node, ast.ImportFrom) or node.level:
            continue
        if not any((node.module, alias.name) in moves for alias in node.names):
            continue
        groups: dict[str, list[str]] = defaultdict(list)
        for alias in node.names:
            target = moves.get((node.module or "", alias.name), node.module or "")
            groups[target].append(alias.name + (f" as {alias.asname}" if alias.asname else ""))
        indent = "\n" + " " * node.col_offset
        lines = [f"from {module} import {', '.join(names)}" for module, names in groups.items() if module != own]
        begin = starts[node.lineno - 1] + node.col_offset
        end = starts[node.end_lineno - 1] + node.end_col_offset
        edits.append((begin, end, indent.join(lines) or "pass"))
    for begin, end, new in sorted(edits, reverse=True):
        data = data[:begin] + new.encode() + data[end:]
    return data.decode()


if __name__ == "__main__":
    sys.exit(main())
