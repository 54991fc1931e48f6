"""Make records of more than four fields keyword-only, and name the arguments wherever one is built or matched.

    python tools/rename/keyword_records.py [--apply]      # from the root of a git checkout

A record is a dataclass or a msgspec structure. Calls are found through imports, and through `cls(...)` inside the
class. What cannot be rewritten (a starred argument) is printed.
"""

from __future__ import annotations

import ast
import sys
from dataclasses import dataclass, field
from pathlib import Path

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))
from structure.__main__ import MAX_POSITIONAL, is_class_variable, is_record, keyword_only

TOPS = ("src", "tests", "benchmarks", "experiments", "examples", "scripts", "tools")


@dataclass
class Record:
    """A record class: where it is, and its fields in order."""

    module: str
    name: str
    bases: list[str]
    own: list[str]
    keyword: bool
    node: ast.ClassDef
    path: Path
    fields: list[str] = field(default_factory=list)
    convert: bool = False


def module_of(path: Path) -> str:
    """The dotted name of a file."""
    parts = path.with_suffix("").parts
    return ".".join(parts[1:] if parts[0] in ("src", "benchmarks") else parts).removesuffix(".__init__")


def names_of(tree: ast.Module, module: str) -> dict[str, tuple[str, str]]:
    """Which (module, name) each imported or defined class name in a file means; modules map to (name, "")."""
    found: dict[str, tuple[str, str]] = {}
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module:
            for alias in node.names:
                found[alias.asname or alias.name] = (node.module, alias.name)
        elif isinstance(node, ast.ClassDef):
            found.setdefault(node.name, (module, node.name))
    return found


def main() -> int:
    """Print what would be done, or do it."""
    apply = "--apply" in sys.argv
    files: dict[Path, tuple[str, ast.Module, str]] = {}
    for top in TOPS:
        for path in sorted(Path(top).rglob("*.py")):
            text = path.read_text()
            files[path] = text, ast.parse(text), module_of(path)
    known: dict[tuple[str, str], Record] = {}
    scopes = {path: names_of(tree, module) for path, (_, tree, module) in files.items()}
    for path, (_, tree, module) in files.items():
        for node in ast.walk(tree):
            if isinstance(node, ast.ClassDef):
                own = [
                    one.target.id
                    for one in node.body
                    if isinstance(one, ast.AnnAssign)
                    and isinstance(one.target, ast.Name)
                    and not is_class_variable(one)
                ]
                bases = [ast.unparse(one) for one in node.bases]
                record = Record(module, node.name, bases, own, keyword_only(node), node, path)
                record.convert = is_record(node) and not record.keyword and len(own) > MAX_POSITIONAL
                record.convert &= path.parts[0] == "src" and node.name != "FilterResult"
                if is_record(node) or any(resolve(scopes[path], base) in known for base in bases):
                    known[module, node.name] = record
    for record in known.values():
        record.fields = all_fields(record, known, scopes)
    converted = {key: one for key, one in known.items() if one.convert}
    done = 0
    for path, (text, tree, _) in files.items():
        edits: list[tuple[int, int, str]] = []
        starts = offsets(text)
        for owner, node in walk_with_class(tree):
            if isinstance(node, ast.Call):
                record = target(node.func, scopes[path], converted, owner, files[path][2])
                if record is None or not node.args:
                    continue
                if any(isinstance(one, ast.Starred) for one in node.args):
                    sys.stdout.write(f"{path}:{node.lineno}: {record.name}(*...) must be rewritten by hand\n")
                    continue
                for name, one in zip(record.fields, node.args, strict=False):
                    begin = starts[one.lineno - 1] + one.col_offset
                    while text.encode()[begin - 1 : begin] == b"(" and parenthesised(
                        text.encode(), begin, node, starts
                    ):
                        begin -= 1
                    edits.append((begin, begin, f"{name}="))
                done += 1
            elif isinstance(node, ast.MatchClass) and node.patterns:
                record = target(node.cls, scopes[path], converted, owner, files[path][2])
                if record is None:
                    continue
                for name, one in zip(record.fields, node.patterns, strict=False):
                    begin = starts[one.lineno - 1] + one.col_offset
                    edits.append((begin, begin, f"{name}="))
                done += 1
        for record in converted.values():
            if record.path == path:
                edits += declare(record, text, starts)
        if edits and apply:
            data = text.encode()
            for begin, end, new in sorted(edits, reverse=True):
                data = data[:begin] + new.encode() + data[end:]
            path.write_text(data.decode())
    sys.stdout.write(f"{len(converted)} records, {done} calls and patterns\n")
    return 0


def parenthesised(data: bytes, begin: int, call: ast.Call, starts: list[int]) -> bool:
    """Whether the bracket before `begin` belongs to the argument and not to the call."""
    opening = starts[call.func.end_lineno - 1] + call.func.end_col_offset
    return begin - 1 > opening


def offsets(text: str) -> list[int]:
    """Byte offset of each line."""
    found = [0]
    for line in text.splitlines(keepends=True):
        found.append(found[-1] + len(line.encode()))
    return found


def walk_with_class(tree: ast.AST, owner: str = "") -> list[tuple[str, ast.AST]]:
    """Every node with the name of the class around it."""
    found: list[tuple[str, ast.AST]] = []
    for node in ast.iter_child_nodes(tree):
        found.append((owner, node))
        found += walk_with_class(node, node.name if isinstance(node, ast.ClassDef) else owner)
    return found


def resolve(scope: dict[str, tuple[str, str]], name: str) -> tuple[str, str]:
    """The class that a name means in a file."""
    first, _, rest = name.partition(".")
    found = scope.get(first, ("", first))
    return (f"{found[0]}.{found[1]}", rest) if rest else found


def target(
    function: ast.expr, scope: dict[str, tuple[str, str]], known: dict[tuple[str, str], Record], owner: str, module: str
) -> Record | None:
    """The record that a call builds."""
    if not isinstance(function, (ast.Name, ast.Attribute)):
        return None
    name = ast.unparse(function)
    if name in ("cls", "type(self)", "Self") and owner:
        return known.get((module, owner))
    return known.get(resolve(scope, name))


def all_fields(
    record: Record, known: dict[tuple[str, str], Record], scopes: dict[Path, dict[str, tuple[str, str]]]
) -> list[str]:
    """The fields with those of the bases before them."""
    found: list[str] = []
    for base in record.bases:
        above = known.get(resolve(scopes[record.path], base))
        if above is not None:
            found += [name for name in all_fields(above, known, scopes) if name not in found]
    return found + [name for name in record.own if name not in found]


def declare(record: Record, text: str, starts: list[int]) -> list[tuple[int, int, str]]:
    """The edit that adds `kw_only=True` to the declaration."""
    node = record.node
    for one in node.decorator_list:
        words = ast.unparse(one)
        if "dataclass" in words:
            end = starts[one.end_lineno - 1] + one.end_col_offset
            if isinstance(one, ast.Call):
                return [(end - 1, end - 1, ", kw_only=True" if one.keywords or one.args else "kw_only=True")]
            return [(end, end, "(kw_only=True)")]
    last = node.keywords[-1].value if node.keywords else node.bases[-1]
    end = starts[last.end_lineno - 1] + last.end_col_offset
    return [(end, end, ", kw_only=True")]


if __name__ == "__main__":
    sys.exit(main())
