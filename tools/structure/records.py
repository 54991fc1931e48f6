"""The rule `records`: records of more than four fields cannot be built by position, so that no two can be swapped."""

from __future__ import annotations

import ast
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field

MAX_POSITIONAL = 4
STRUCT_BASES = ("Struct",)
"""Names of external classes whose subclasses take their annotated fields as arguments, at any depth."""


@dataclass(frozen=True)
class Module:
    """The top level names of one module: its imports as dotted names, and its classes."""

    imports: Mapping[str, str]
    classes: Mapping[str, ast.ClassDef]


@dataclass
class Records:
    """The classes of all sources, for the resolution of base classes across modules."""

    modules: dict[str, Module] = field(default_factory=dict[str, Module])

    @classmethod
    def of(cls, sources: Iterable[tuple[str, ast.Module]]) -> Records:
        """Read the sources, given as pairs of dotted module name and syntax tree."""
        return cls({name: Module(dict(_imported_names(tree)), dict(_classes(tree))) for name, tree in sources})

    def violations(self, exempt: Mapping[str, str]) -> Iterator[tuple[str, ast.ClassDef, str]]:
        """Module, class and message of each record that may be built from too many positions; skips `exempt` names."""
        for name, module in self.modules.items():
            for node in module.classes.values():
                count = self.positional_fields(name, node)
                if count > MAX_POSITIONAL and f"{name}.{node.name}" not in exempt:
                    fix = "is a NamedTuple" if _is_named_tuple(node) else "is not keyword-only"
                    yield name, node, f"{node.name} has {count} fields and {fix}"

    def positional_fields(self, module: str, node: ast.ClassDef) -> int:
        """Number of own and inherited fields that the constructor takes by position; 0 if `node` is no record."""
        if not (_is_dataclass(node) or _is_named_tuple(node) or self.is_struct(module, node)):
            return 0
        own = 0 if _is_keyword_only(node) else len(list(_positional(node)))
        return own + sum(self.positional_fields(*base) for base in self.bases(module, node))

    def is_struct(self, module: str, node: ast.ClassDef) -> bool:
        """Whether a class is derived from a msgspec structure, directly or through classes of the sources."""
        external = any(ast.unparse(one).split(".")[-1] in STRUCT_BASES for one in node.bases)
        return external or any(self.is_struct(*base) for base in self.bases(module, node))

    def bases(self, module: str, node: ast.ClassDef) -> Iterator[tuple[str, ast.ClassDef]]:
        """Module and definition of each base class that is defined in the sources."""
        for base in node.bases:
            origin = base.value if isinstance(base, ast.Subscript) else base
            found = self.resolve(module, ast.unparse(origin), set())
            if found is not None and found[1] is not node:
                yield found

    def resolve(self, module: str, dotted: str, seen: set[tuple[str, str]]) -> tuple[str, ast.ClassDef] | None:
        """The class that `dotted` names in `module`, also through packages that export it again; None if external."""
        if module not in self.modules or (module, dotted) in seen:
            return None
        seen.add((module, dotted))
        here = self.modules[module]
        if dotted in here.classes:
            return module, here.classes[dotted]
        head, _, rest = dotted.partition(".")
        target = here.imports.get(head, "") + (f".{rest}" if rest else "")
        owner, _, name = target.rpartition(".")
        return self.resolve(owner, name, seen)


def _classes(tree: ast.Module) -> Iterator[tuple[str, ast.ClassDef]]:
    """Every class of a module with its name, also those inside functions and classes."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ClassDef):
            yield node.name, node


def _imported_names(tree: ast.Module) -> Iterator[tuple[str, str]]:
    """Each imported name with the dotted name that it is imported from."""
    for node in ast.walk(tree):
        if isinstance(node, ast.ImportFrom) and node.module and not node.level:
            for alias in node.names:
                yield alias.asname or alias.name, f"{node.module}.{alias.name}"
        elif isinstance(node, ast.Import):
            for alias in node.names:
                top = alias.name.partition(".")[0]
                yield alias.asname or top, alias.name if alias.asname else top


def _is_dataclass(node: ast.ClassDef) -> bool:
    return any("dataclass" in ast.unparse(one) for one in node.decorator_list)


def _is_named_tuple(node: ast.ClassDef) -> bool:
    return any(ast.unparse(one).split(".")[-1] == "NamedTuple" for one in node.bases)


def _positional(node: ast.ClassDef) -> Iterator[ast.AnnAssign]:
    """Fields of the class body that the constructor takes by position."""
    for one in node.body:
        if not isinstance(one, ast.AnnAssign):
            continue
        annotation = ast.unparse(one.annotation)
        value = "" if one.value is None else ast.unparse(one.value)
        if "KW_ONLY" in annotation:
            return
        if "ClassVar" not in annotation and "kw_only=True" not in value and "init=False" not in value:
            yield one


def _is_keyword_only(node: ast.ClassDef) -> bool:
    """Whether the class is declared `kw_only=True`."""
    options = [*node.keywords]
    for one in node.decorator_list:
        if isinstance(one, ast.Call):
            options += one.keywords
    return any(one.arg == "kw_only" and ast.unparse(one.value) == "True" for one in options)
