"""Move modules to their new places and rewrite every import, dotted string and path that names them.

    python tools/rename/move.py TABLE [TABLE ...]      # from the root of a git checkout

A table has one line per file: ``old = new`` moves a file, ``old > new`` appends a module to another one. Imports are
rewritten from the syntax tree; dotted names in strings, and paths in text files, by longest match. The script may be
run again: a file that has been moved is skipped.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections import defaultdict
from pathlib import Path

TEXT = {".py", ".md", ".toml", ".sh", ".txt", ".yaml", ".yml", ".cfg", ".c", ".h", ".cpp", ".pyi", ""}
SKIP = ("tools/rename/", "docs/results/", "CHANGELOG.md", "vectors/", "LICENSE")
ROOTS = {"src/": "", "benchmarks/": ""}
"""Folders on the import path before the move, besides the root of the repository."""


class Table:
    """Where each file and each module goes."""

    def __init__(self, paths: list[Path]) -> None:
        """Read the tables."""
        self.files: dict[str, str] = {}
        self.merged: dict[str, str] = {}
        self.new: list[str] = []
        self.deleted: list[str] = []
        for path in paths:
            for line in path.read_text().splitlines():
                found = re.match(r"^(\S+) ([=>]) (\S+)", line)
                if not found or line.startswith("#"):
                    continue
                old, kind, new = found.groups()
                if old == "NEW":
                    self.new.append(new)
                elif new == "DELETED" or (kind == ">" and old.endswith("__init__.py")):
                    self.deleted.append(old)
                elif kind == ">":
                    self.merged[old] = new
                else:
                    self.files[old] = new
        self.modules: dict[str, str] = {}
        for old, new in (self.files | self.merged).items():
            if old.endswith(".py"):
                self.modules[dotted(old)] = dotted(new, after=True)

        self.names, self.paths, self.moved = patterns(self)

    def matches(self, text: str) -> list[tuple[int, int, str]]:
        """Where `text` names a module or a file that has moved: (begin, end, new text), not overlapping."""
        found = [(*one.span(), self.modules[one.group(0)]) for one in self.names.finditer(text)]
        spans = [(begin, end) for begin, end, _ in found]
        for one in self.paths.finditer(text):
            if not any(begin < one.end() and one.start() < end for begin, end in spans):
                found.append((*one.span(), self.moved[one.group(0)]))
        return found

    def rewrite(self, text: str) -> str:
        """Dotted names and paths in any text."""
        for begin, end, new in sorted(self.matches(text), reverse=True):
            text = text[:begin] + new + text[end:]
        return text

    def module(self, name: str) -> str:
        """The new name of a module; packages that only hold moved modules map by their __init__."""
        return self.modules.get(name, name)


def dotted(path: str, *, after: bool = False) -> str:
    """The module name of a file."""
    for root in ("src/",) if after else ("src/", "benchmarks/"):
        path = path.removeprefix(root)
    return path.removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def git(*arguments: str) -> str:
    """Run git and return its output."""
    return subprocess.run(["git", *arguments], check=True, capture_output=True, text=True).stdout


class Rewriter:
    """Edits of one Python source."""

    def __init__(self, table: Table, source: str, own_old: str, own_new: str, is_package: bool) -> None:
        """`own_*`: the module's name before and after."""
        self.table, self.source, self.own_old, self.own_new, self.package = table, source, own_old, own_new, is_package
        self.tree = ast.parse(source)
        self.lines = source.splitlines(keepends=True)
        self.edits: list[tuple[int, int, str]] = []
        self.renamed: dict[str, str] = {}
        starts = [0]
        for line in self.lines:
            starts.append(starts[-1] + len(line.encode()))
        self.starts = starts

    def run(self) -> str:
        """The rewritten source."""
        for node in ast.walk(self.tree):
            if isinstance(node, ast.ImportFrom):
                self._import_from(node)
            elif isinstance(node, ast.Import):
                self._import(node)
        self._names()
        self._strings()
        data = self.source.encode()
        for begin, end, text in sorted(self.edits, reverse=True):
            data = data[:begin] + text.encode() + data[end:]
        return data.decode()

    def _span(self, node: ast.AST) -> tuple[int, int]:
        return (
            self.starts[node.lineno - 1] + node.col_offset,
            self.starts[node.end_lineno - 1] + node.end_col_offset,
        )

    def _absolute(self, node: ast.ImportFrom) -> str:
        if not node.level:
            return node.module or ""
        parts = self.own_old.split(".")
        if not self.package:
            parts = parts[:-1]
        parts = parts[: len(parts) - node.level + 1]
        return ".".join([*parts, *([node.module] if node.module else [])])

    def _import_from(self, node: ast.ImportFrom) -> None:
        module = self._absolute(node)
        groups: dict[str, list[str]] = defaultdict(list)
        changed = bool(node.level)
        for alias in node.names:
            full = f"{module}.{alias.name}"
            if full in self.table.modules:
                new = self.table.modules[full]
                parent, _, name = new.rpartition(".")
                if not parent:
                    parent, name = "", name
                bound = alias.asname
                if alias.asname is None and name != alias.name:
                    if self._free(name, alias.name):
                        self.renamed[alias.name] = name
                    else:
                        bound = alias.name
                item = name + (f" as {bound}" if bound and bound != name else "")
                groups[parent].append(item)
                changed |= new != full
            else:
                new = self.table.module(module)
                groups[new].append(alias.name + (f" as {alias.asname}" if alias.asname else ""))
                changed |= new != module
        if not changed:
            return
        indent = " " * node.col_offset
        statements = []
        for parent, items in groups.items():
            if parent == self.own_new:
                continue
            statements.append(f"from {parent} import {', '.join(items)}" if parent else f"import {', '.join(items)}")
        self.edits.append((*self._span(node), f"\n{indent}".join(statements) or "pass"))

    def _free(self, name: str, old: str) -> bool:
        """Whether `name` is not bound in this file, and `old` is bound only by its import."""
        bound = 0
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Name) and node.id == name:
                return False
            if isinstance(node, ast.arg) and node.arg in (name, old):
                return False
            if isinstance(node, (ast.FunctionDef, ast.ClassDef)) and node.name in (name, old):
                return False
            if isinstance(node, ast.Name) and node.id == old and isinstance(node.ctx, ast.Store):
                return False
            if isinstance(node, (ast.Import, ast.ImportFrom)):
                for alias in node.names:
                    if (alias.asname or alias.name) == name:
                        return False
                    bound += (alias.asname or alias.name) == old
        return bound == 1

    def _import(self, node: ast.Import) -> None:
        names, changed = [], False
        for alias in node.names:
            new = self.table.module(alias.name)
            changed |= new != alias.name
            names.append(new + (f" as {alias.asname}" if alias.asname else ""))
        if changed:
            self.edits.append((*self._span(node), "import " + ", ".join(names)))

    def _strings(self) -> None:
        """Dotted names and paths in strings and comments."""
        taken = sorted((begin, end) for begin, end, _ in self.edits)
        imports = [self._span(node) for node in ast.walk(self.tree) if isinstance(node, (ast.Import, ast.ImportFrom))]
        data = self.source
        for begin, end, text in self.table.matches(data):
            first, last = len(data[:begin].encode()), len(data[:end].encode())
            if not any(a < last and first < b for a, b in [*taken, *imports]):
                self.edits.append((first, last, text))

    def _names(self) -> None:
        for node in ast.walk(self.tree):
            if isinstance(node, ast.Name) and node.id in self.renamed:
                self.edits.append((*self._span(node), self.renamed[node.id]))


def merge(target: str, source: str, own: str) -> str:
    """`source` appended to `target`: imports to the top, the docstring dropped."""
    tree = ast.parse(source)
    lines = source.splitlines(keepends=True)
    body = tree.body
    if body and isinstance(body[0], ast.Expr) and isinstance(body[0].value, ast.Constant):
        body = body[1:]
    imports, rest_from = [], None
    for node in body:
        if isinstance(node, (ast.Import, ast.ImportFrom)) and rest_from is None:
            imports.append("".join(lines[node.lineno - 1 : node.end_lineno]))
        elif rest_from is None:
            rest_from = max((other.end_lineno for other in tree.body if other.end_lineno < node.lineno), default=0)
    rest = "".join(lines[rest_from:]) if rest_from is not None else ""
    imports = [one for one in imports if "__future__" not in one and f"from {own} import" not in one]
    into = ast.parse(target)
    heads = [node for node in into.body if isinstance(node, (ast.Import, ast.ImportFrom))]
    at = heads[-1].end_lineno if heads else (into.body[0].end_lineno if into.body else 0)
    whole = target.splitlines(keepends=True)
    return "".join(whole[:at]) + "".join(imports) + "".join(whole[at:]).rstrip() + "\n\n\n" + rest.strip("\n") + "\n"


def patterns(table: Table) -> tuple[re.Pattern[str], re.Pattern[str], dict[str, str]]:
    """What to look for in strings and documents."""
    old = sorted((name for name, new in table.modules.items() if "." in name and name != new), key=len, reverse=True)
    old = [
        name
        for name in old
        if name.startswith(("dualbrain.", "tests.", "proofs.", "peers.", "limits.", "mutation.", "outsider."))
    ]
    names = (
        re.compile(r"(?<![\w./])(?:" + "|".join(map(re.escape, old)) + r")(?![\w/])") if old else re.compile(r"(?!)")
    )
    moved: dict[str, str] = {}
    for before, after in (table.files | table.merged).items():
        if before == after:
            continue
        moved[before] = after
        short = before.removeprefix("src/dualbrain/")
        if short != before and "/" in short and not before.endswith("__init__.py"):
            moved[short] = after.removeprefix("src/dualbrain/")
        short = before.removeprefix("benchmarks/")
        if short != before and "/" in short and before.startswith("benchmarks/proofs"):
            moved[short] = after
    keys = sorted(moved, key=len, reverse=True)
    paths = (
        re.compile(r"(?<![\w./-])(?:" + "|".join(map(re.escape, keys)) + r")(?![\w/-])")
        if keys
        else re.compile(r"(?!)")
    )
    return names, paths, moved


def main() -> int:
    """Do all of it."""
    table = Table([Path(one) for one in sys.argv[1:]])
    tracked = git("ls-files").split("\n")
    contents: dict[str, str] = {}
    for file in filter(None, tracked):
        path = Path(file)
        if not path.exists() or path.suffix not in TEXT or file.startswith(SKIP):
            continue
        try:
            text = path.read_text()
        except UnicodeDecodeError:
            continue
        new_file = (table.files | table.merged).get(file, file)
        if path.suffix == ".py":
            own = dotted(new_file, after=True)
            text = Rewriter(table, text, dotted(file), own, path.name == "__init__.py").run()
        else:
            text = table.rewrite(text)
        contents[file] = text
    for old, new in table.files.items():
        if old != new and Path(old).exists():
            Path(new).parent.mkdir(parents=True, exist_ok=True)
            git("mv", old, f"{new}.moving")
    for old, new in table.files.items():
        if Path(f"{new}.moving").exists():
            git("mv", "-f", f"{new}.moving", new)
    for file, text in contents.items():
        if file not in table.merged:
            Path(table.files.get(file, file)).write_text(text)
    for old, new in table.merged.items():
        if old in contents:
            target = Path(new)
            target.write_text(merge(target.read_text(), contents[old], dotted(new, after=True)))
            git("rm", "-q", "-f", old)
    for old in table.deleted:
        if Path(old).exists():
            git("rm", "-q", "-f", old)
    for new in table.new:
        path = Path(new)
        path.parent.mkdir(parents=True, exist_ok=True)
        if not path.exists():
            path.write_text("")
    git("add", "-A")
    return 0


if __name__ == "__main__":
    sys.exit(main())
