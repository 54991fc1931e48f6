"""dualbrain memory connect: the file of a ledger on a PostgreSQL server, which several robots share."""

from __future__ import annotations

import shlex
import socket
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import msgspec
from cyclopts import Parameter
from rich.markup import escape

from dualbrain.cli.common.console import StderrConsole
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.core.storage.private_files import create_private_folder, open_private
from dualbrain.core.text import count_noun
from dualbrain.errors import DECODE_ERRORS, UsageError

if TYPE_CHECKING:
    from dualbrain.memory.ledger.shared.config import SharedLedgerConfig
    from dualbrain.memory.ledger.store import LedgerStore

Flag = Annotated[bool, Parameter(negative="")]


def connect(
    url: str,
    file: Path,
    /,
    *,
    name: str = "",
    namespace: str = "dualbrain",
    use_memories_of: tuple[str, ...] = (),
    index: str = "scan",
    create: Flag = False,
    same_robot: Flag = False,
) -> int:
    """Write the file of a ledger on a PostgreSQL server, which any command takes as --ledger.

    The file contains no password: the client reads it from ~/.pgpass. An existing file is not replaced, and a name
    under which a robot has written already is refused.

    Parameters
    ----------
    url
        Address of the server, such as postgresql://robot7@server/lab, without a password.
    file
        The file, which ends in .toml and must not exist.
    name
        Name under which this robot writes, one for each robot. Default: the name of this machine.
    namespace
        Schema with the tables of the ledger.
    use_memories_of
        Only memories of these robots are retrieved and trained on. Default: of all robots.
    index
        Where the vectors are searched: `scan` in RAM, `pgvector` on the server, or `milvus:ADDRESS`.
    create
        Create the tables, unless they exist.
    same_robot
        The robot that wrote under this name before is this one, for example on a new disk.
    """
    from dualbrain.memory.ledger.shared.config import SCAN, SharedLedgerConfig, format_shared_config, is_shared
    from dualbrain.memory.ledger.shared.replicated_store import require_postgres

    if not is_shared(file):
        raise UsageError("FILE", got=str(file), allowed="a name that ends in .toml")
    require_postgres()
    from dualbrain.memory.ledger.postgres.store import PostgresStore

    fields = {
        "url": url,
        "name": name or socket.gethostname(),
        "namespace": namespace,
        "use_memories_of": use_memories_of,
        "index": index,
    }
    try:
        config = msgspec.convert(fields, SharedLedgerConfig)
    except DECODE_ERRORS as error:
        raise UsageError.stating(
            f"{error}.", fix="Names contain letters, digits and . _ -; an index is scan, pgvector or milvus:ADDRESS."
        ) from error
    store = PostgresStore.open(config.url, config.namespace, create=create)
    try:
        head, missing = store.head(), store.missing_objects
        if not same_robot:
            _require_unused_name(store, config.name)
    finally:
        store.close()
    if config.index != SCAN:
        grant = _prepare_engine(config)
        StderrConsole().print(f"the engine of the index is ready{f'; for each role: {escape(grant)}' if grant else ''}")
    create_private_folder(file.parent)
    try:
        with open_private(file, "xb") as out:
            out.write(format_shared_config(config).encode())
    except FileExistsError as error:
        raise UsageError.stating(f"{file} exists already.", fix="Name another file, or remove it.") from error
    for one in missing:
        StderrConsole().print(f"[yellow]the {escape(one)} is missing on the server[/]")
    StderrConsole().print(
        f"{escape(str(file))}: this robot writes as {config.name}; the ledger has {head.seq} events.\n"
        f"Try: dualbrain memory list --ledger {escape(shlex.quote(str(file)))}"
    )
    return ExitCode.SUCCESS


def _prepare_engine(config: SharedLedgerConfig) -> str:
    """Create the tables of the engine unless they exist; returns the statement that lets a role use them, or ""."""
    from dualbrain.cli.memory.open_memory import load_encoder
    from dualbrain.memory.embedding.joint_embedding import EmbeddingConfig, JointEmbedding
    from dualbrain.memory.index.engines.choice import open_engine

    dim = JointEmbedding(load_encoder(), (), EmbeddingConfig()).dim
    engine = open_engine(config.index, url=config.url, namespace=config.namespace, dim=dim)
    engine.close()
    return getattr(engine, "grant", "")


def _require_unused_name(store: LedgerStore, name: str) -> None:
    """Raise `UsageError` if the ledger has a run of a robot called `name`."""
    from dualbrain.memory.ledger.runs import STARTED
    from dualbrain.memory.ledger.store import EventQuery

    runs = [event.run for event in store.events(EventQuery(kinds=(STARTED,))) if event.run.startswith(f"{name}/")]
    if runs:
        raise UsageError.stating(
            f"A robot has written {count_noun(len(runs), 'run')} under the name {name}, the last one {runs[-1]}.",
            fix="Give this robot another --name, or --same-robot if it is the same one.",
        )
