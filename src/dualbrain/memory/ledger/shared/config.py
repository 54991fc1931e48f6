"""The file that names a shared ledger (TOML): address of the server, name of this robot, and whose memories it uses."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Annotated

import msgspec

from dualbrain.core.storage.private_files import refuse_special_file
from dualbrain.errors import DECODE_ERRORS, ConfigurationError, MissingDependencyError

SHARED_SUFFIX = ".toml"
"""Suffix of a file that names a shared ledger instead of containing one."""
MAX_FILE_BYTES = 1 << 16
SCAN = "scan"
"""The index that keeps all vectors in RAM and scans them."""
RobotName = Annotated[str, msgspec.Meta(pattern=r"^[A-Za-z0-9][A-Za-z0-9_.-]{0,63}$")]
Namespace = Annotated[str, msgspec.Meta(pattern=r"^[a-z_][a-z0-9_]{0,47}$")]


class SharedLedgerConfig(msgspec.Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """A ledger on a PostgreSQL server.

    `url` is a connection URI without a password. `name` is the name under which this robot writes. `namespace` is the
    schema with the tables, so that one database may contain several ledgers. Only memories of the robots in
    `use_memories_of` are retrieved and trained on (empty: of all robots of the ledger). `index` is "scan" for an index
    in RAM, "pgvector", or "milvus:ADDRESS" (see `memory.index.engines`).
    """

    url: str
    name: RobotName
    namespace: Namespace = "dualbrain"
    use_memories_of: tuple[RobotName, ...] = ()
    index: Annotated[str, msgspec.Meta(pattern=r"^(scan|pgvector|milvus:.+)$")] = SCAN


def is_shared(path: Path) -> bool:
    """Whether the file `path` names a shared ledger on a server."""
    return path.suffix == SHARED_SUFFIX


def read_shared_config(path: Path) -> SharedLedgerConfig:
    """Read and check the file at `path`; raises `MissingDependencyError` or `ConfigurationError`."""
    fix = f"Create it with `dualbrain memory connect URL {path}`."
    if not path.exists():
        raise MissingDependencyError(f"The file of the shared ledger, {path},", fix=fix)
    refuse_special_file(path.resolve(), "file of the shared ledger")
    try:
        with path.open("rb") as file:
            return msgspec.toml.decode(file.read(MAX_FILE_BYTES), type=SharedLedgerConfig)
    except (OSError, *DECODE_ERRORS) as error:
        raise ConfigurationError.stating(
            f"The file of the shared ledger cannot be used: {error}. {path}", fix=f"Correct it. {fix}"
        ) from error


def format_shared_config(config: SharedLedgerConfig) -> str:
    """The text of the file for `config`."""
    lines = [
        "# A memory ledger on a PostgreSQL server: use this file as --ledger. It contains no password (see ~/.pgpass).",
        f"url = {json.dumps(config.url)}",
        f"name = {json.dumps(config.name)}  # the name under which this robot writes; one for each robot",
        f"namespace = {json.dumps(config.namespace)}  # the schema with the tables",
        f"use_memories_of = {json.dumps(list(config.use_memories_of))}  # empty: of all robots",
        f'index = {json.dumps(config.index)}  # "scan", "pgvector" or "milvus:ADDRESS"',
    ]
    return "\n".join(lines) + "\n"
