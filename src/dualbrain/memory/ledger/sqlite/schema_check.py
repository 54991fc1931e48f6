"""Check that a ledger file contains the declared tables, indices and triggers and nothing else.

A foreign trigger changes events while they are written, and a view or a generated column shows other events than those
that are stored. No version of dualbrain creates one, so such a file is refused before anything in it is read.
"""

from __future__ import annotations

import shlex
import sqlite3
from pathlib import Path

from dualbrain.memory.ledger.hash_chain import CorruptLedgerError
from dualbrain.memory.ledger.sqlite.tables import declared_objects, read_schema_version, stored_objects


def check_meta_table(database: sqlite3.Connection, path: Path) -> None:
    """Raise `CorruptLedgerError` if the table with the schema version is not the declared one; an empty file passes."""
    stored = stored_objects(database)
    if stored and stored.get(("table", "meta")) != declared_objects(1)["table", "meta"]:
        kind = next((kind for kind, name in stored if name == "meta"), "")
        fault = f"its {kind} 'meta' is not the declared table" if kind else "it has no table 'meta'"
        raise CorruptLedgerError(fault, seq=None, path=str(path))


def check_objects(database: sqlite3.Connection, path: Path) -> tuple[str, ...]:
    """The declared indices and triggers that are missing; raises `CorruptLedgerError` for any other difference."""
    declared, stored = declared_objects(read_schema_version(database)), stored_objects(database)
    for (kind, name), sql in stored.items():
        expected = declared.get((kind, name))
        if expected == sql:
            continue
        what = _describe(kind, sql)
        if expected is None:
            fault = f"it contains the {what} {name!r}, which dualbrain did not create"
            raise CorruptLedgerError(fault, seq=None, path=str(path), fix=_removal(kind, name, path))
        fault = f"its {what} {name!r} is not the declared one"
        raise CorruptLedgerError(fault, seq=None, path=str(path))
    missing = sorted(declared.keys() - stored.keys())
    if tables := [name for kind, name in missing if kind == "table"]:
        raise CorruptLedgerError(f"its table {tables[0]!r} is missing", seq=None, path=str(path))
    return tuple(f"{kind} {name!r}" for kind, name in missing)


def missing_objects_error(missing: tuple[str, ...], path: Path) -> CorruptLedgerError:
    """The error for a ledger without declared indices or triggers, which must not be written."""
    command = f"`dualbrain memory verify --ledger {path} --accept REASON`"
    fix = f"Verify it; if everything else is intact, {command} creates them again. Or restore a copy."
    return CorruptLedgerError(f"its {', '.join(missing)} is missing", seq=None, path=str(path), fix=fix)


def _removal(kind: str, name: str, path: Path) -> str:
    """The remedy for a foreign object; no command for a name that a terminal cannot show."""
    if not name.isprintable() or name.startswith("sqlite_"):
        return "Restore a copy."
    quoted = name.replace('"', '""')
    command = shlex.join(["sqlite3", str(path), f'DROP {kind.upper()} "{quoted}"'])
    return f"Find out what it did; then remove it with {command} and run `dualbrain memory verify`, or restore a copy."


def _describe(kind: str, sql: str) -> str:
    return "virtual table" if sql.upper().startswith("CREATE VIRTUAL") else kind
