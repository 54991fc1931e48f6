"""Rules on names and layout that `make check` enforces; prints every finding and exits with 1 if there is one.

    python -m tools.structure [--root FOLDER] [RULE ...]

Rules: `folders` (at most 12 entries in a folder), `cycles` (no import cycles between modules), `records` (records of
more than four fields are keyword-only), `words` (no private vocabulary in code, tests, documents and help), `allowed`
(no exception from `words` without an occurrence), `docs` (every public name is documented). The rules and their
exceptions, each with its reason, are in `rules.toml`; the words that an area may use are in `allowed/AREA.toml`.
"""

from __future__ import annotations

import argparse
import ast
import re
import subprocess
import sys
import tomllib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fnmatch import fnmatch
from pathlib import Path
from typing import Any

from tools.structure.records import Records

MAX_ENTRIES = 12
PACKAGE = "src/dualbrain"
RECORD_TOPS = (PACKAGE, "experiments", "benchmarks", "tools")
NOT_COUNTED = {"__init__.py", "conftest.py", "py.typed"}


@dataclass(frozen=True)
class Tree:
    """The tracked files below `root`, and the exceptions from the rules."""

    root: Path
    files: tuple[str, ...]
    config: dict[str, Any]

    @classmethod
    def of(cls, root: Path) -> Tree:
        """The tree in the git checkout `root`, with files that are not yet committed."""
        command = ["git", "-C", str(root), "ls-files", "--cached", "--others", "--exclude-standard"]
        listed = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
        folder = root / "tools" / "structure"
        config = tomllib.loads((folder / "rules.toml").read_text("utf-8"))
        for path in sorted((folder / "allowed").glob("*.toml")):
            config["words"].setdefault("allowed", []).extend(tomllib.loads(path.read_text("utf-8"))["allowed"])
        return cls(root, tuple(sorted({name for name in listed if (root / name).is_file()})), config)

    def text(self, name: str) -> str:
        """The text of a file."""
        return (self.root / name).read_text("utf-8")

    def python(self, *tops: str) -> Iterator[tuple[str, ast.Module]]:
        """Python sources below any of `tops`, parsed."""
        for name in self.files:
            if name.endswith(".py") and name.startswith(tuple(f"{top}/" for top in tops)):
                yield name, ast.parse(self.text(name))


def folders(tree: Tree) -> Iterator[str]:
    """Folders with more entries than `MAX_ENTRIES`."""
    entries: dict[str, set[str]] = {}
    for name in tree.files:
        parts = name.split("/")
        for depth in range(1, len(parts)):
            entries.setdefault("/".join(parts[:depth]), set()).add(parts[depth])
    exempt: dict[str, str] = tree.config["folders"]
    for folder, found in sorted(entries.items()):
        count = len(found - NOT_COUNTED)
        if count > MAX_ENTRIES and not any(fnmatch(folder, pattern) for pattern in exempt):
            yield f"{folder}: {count} entries, at most {MAX_ENTRIES}"


def cycles(tree: Tree) -> Iterator[str]:
    """Groups of modules that import each other."""
    graph = imports(tree)
    for group in strongly_connected(graph):
        if len(group) > 1:
            yield "import cycle: " + " ↔ ".join(sorted(group))


def imports(tree: Tree) -> dict[str, set[str]]:
    """The modules that each module of the package imports at run time, anywhere in its text."""
    sources = {module_name(name): parsed for name, parsed in tree.python(PACKAGE)}
    graph: dict[str, set[str]] = {name: set() for name in sources}
    for module, parsed in sources.items():
        for node in run_time_nodes(parsed):
            for target in imported(node):
                if target in sources and target != module:
                    graph[module].add(target)
    return graph


def run_time_nodes(tree: ast.AST) -> Iterator[ast.AST]:
    """Every node of a tree that is not below `if TYPE_CHECKING`."""
    for node in ast.iter_child_nodes(tree):
        if not (isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"):
            yield node
            yield from run_time_nodes(node)


def imported(node: ast.AST) -> Iterator[str]:
    """Names of modules that one statement imports; a name imported from a package may be a module, too."""
    if isinstance(node, ast.ImportFrom) and node.module and not node.level:
        yield node.module
        for alias in node.names:
            yield f"{node.module}.{alias.name}"
    elif isinstance(node, ast.Import):
        for alias in node.names:
            yield alias.name


def module_name(path: str) -> str:
    """The dotted name of a source file."""
    return path.removeprefix("src/").removesuffix(".py").removesuffix("/__init__").replace("/", ".")


def strongly_connected(graph: dict[str, set[str]]) -> list[set[str]]:
    """Strongly connected components (Kosaraju), without recursion."""
    backward: dict[str, set[str]] = {name: set() for name in graph}
    for name, targets in graph.items():
        for target in targets:
            backward[target].add(name)
    finished: list[str] = []
    seen: set[str] = set()
    for start in graph:
        finished += finishing(graph, start, seen)
    seen = set()
    return [set(finishing(backward, start, seen)) for start in reversed(finished) if start not in seen]


def finishing(graph: dict[str, set[str]], start: str, seen: set[str]) -> list[str]:
    """Nodes reached from `start` that are not in `seen`, in the order in which a depth-first search leaves them."""
    if start in seen:
        return []
    seen.add(start)
    order: list[str] = []
    stack = [(start, iter(sorted(graph[start])))]
    while stack:
        node, targets = stack[-1]
        for target in targets:
            if target not in seen:
                seen.add(target)
                stack.append((target, iter(sorted(graph[target]))))
                break
        else:
            stack.pop()
            order.append(node)
    return order


def records(tree: Tree) -> Iterator[str]:
    """Dataclasses, structs and named tuples of more than four fields that may be built by position."""
    files = {module_name(name): name for name, _ in tree.python(*RECORD_TOPS)}
    known = Records.of((module_name(name), parsed) for name, parsed in tree.python(*RECORD_TOPS))
    for module, node, message in known.violations(tree.config["records"]):
        yield f"{files[module]}:{node.lineno}: {message}"


def words(tree: Tree) -> Iterator[str]:
    """Private words in names, comments, docstrings, messages and documents."""
    terms = {word: term for term, group in tree.config["words"]["use"].items() for word in group}
    allowed: list[dict[str, Any]] = tree.config["words"].get("allowed", [])
    for name, number, word, line in occurrences(tree):
        if not any(permits(one, name, word, line) for one in allowed):
            yield f"{name}:{number}: {word!r}: use {terms[word]!r}"


def allowed(tree: Tree) -> Iterator[str]:
    """Exceptions from the words that permit no occurrence."""
    found = list(occurrences(tree))
    for exception in tree.config["words"].get("allowed", []):
        permitted = {word for name, _, word, line in found if permits(exception, name, word, line)}
        if unused := sorted(set(exception["words"]) - ({"*"} if permitted else set()) - permitted):
            yield f"exception for {exception['file']} ({exception['reason']}): no occurrence of {', '.join(unused)}"


def occurrences(tree: Tree) -> Iterator[tuple[str, int, str, str]]:
    """Every private word in the files to which the rule applies: (file, line number, word, line)."""
    config = tree.config["words"]
    banned = sorted({word for group in config["use"].values() for word in group}, key=len, reverse=True)
    pattern = re.compile(rf"(?<![^\W_])({'|'.join(banned)})(?![^\W_])", re.IGNORECASE)
    for name in tree.files:
        if name.startswith(tuple(config["where"])) and name.endswith(tuple(config["suffixes"])):
            for number, line in enumerate(tree.text(name).splitlines(), start=1):
                for match in pattern.finditer(split_camel(line)):
                    yield name, number, match[1].lower(), line


def permits(exception: dict[str, Any], name: str, word: str, line: str) -> bool:
    """Whether an exception covers `word` in this line of file `name`; without a pattern `line` it covers every line."""
    covered = fnmatch(name, exception["file"]) and (word in exception["words"] or "*" in exception["words"])
    return covered and ("line" not in exception or re.search(exception["line"], line) is not None)


def split_camel(line: str) -> str:
    """`line` with the parts of CamelCase names apart, so that each counts as a word."""
    return re.sub(r"(?<=[a-z0-9])(?=[A-Z])", "_", line)


def docs(tree: Tree) -> Iterator[str]:
    """Public modules, classes, functions and methods without a docstring."""
    for name, parsed in tree.python(PACKAGE):
        if name.endswith("__main__.py") and ast.get_docstring(parsed):
            continue
        if not ast.get_docstring(parsed):
            yield f"{name}: the module has no docstring"
        yield from undocumented(parsed.body, name, "")


def undocumented(body: list[ast.stmt], name: str, owner: str) -> Iterator[str]:
    """Public definitions in `body` that have no docstring."""
    for node in body:
        if not isinstance(node, (ast.ClassDef, ast.FunctionDef, ast.AsyncFunctionDef)) or node.name.startswith("_"):
            continue
        decorators = {ast.unparse(one) for one in node.decorator_list}
        inherited = {"override", "overload"} & decorators or any(one.endswith(".setter") for one in decorators)
        if not ast.get_docstring(node) and not inherited:
            yield f"{name}:{node.lineno}: {owner}{node.name} has no docstring"
        if isinstance(node, ast.ClassDef):
            yield from undocumented(node.body, name, f"{owner}{node.name}.")


RULES: dict[str, Callable[[Tree], Iterator[str]]] = {
    "folders": folders,
    "cycles": cycles,
    "records": records,
    "words": words,
    "allowed": allowed,
    "docs": docs,
}


def main() -> int:
    """Check the rules that were asked for, by default all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rules", nargs="*", metavar="RULE", help=", ".join(RULES))
    parser.add_argument("--root", type=Path, default=Path(__file__).resolve().parents[2])
    arguments = parser.parse_args()
    if unknown := set(arguments.rules) - set(RULES):
        parser.error(f"unknown rule {', '.join(sorted(unknown))}; known: {', '.join(RULES)}")
    tree = Tree.of(arguments.root)
    found = [(rule, line) for rule in arguments.rules or RULES for line in RULES[rule](tree)]
    for rule, line in found:
        sys.stdout.write(f"{rule}: {line}\n")
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
