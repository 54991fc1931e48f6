"""`dualbrain memory connect`, and a role that may only append."""

import stat
from pathlib import Path

import psycopg
import pytest

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.memory.browse import verify
from dualbrain.cli.memory.connect import connect
from dualbrain.errors import ConfigurationError, MissingDependencyError, UsageError
from dualbrain.memory.ledger.ledger import LedgerReader
from dualbrain.memory.ledger.postgres.store import PostgresStore
from dualbrain.memory.ledger.shared import replicated_store
from dualbrain.memory.ledger.shared.config import read_shared_config
from tests.memory.ledger.shared.robots import Lab
from tests.memory.memory_samples import NOW, REST_POSTURE, episode, open_memory

GRANTS = (
    "GRANT USAGE ON SCHEMA {schema} TO {role}",
    "GRANT SELECT ON ALL TABLES IN SCHEMA {schema} TO {role}",
    "GRANT INSERT ON {schema}.event, {schema}.embedding TO {role}",
)
"""As in docs/how-to/memory/shared_memory.md."""


def test_connect_creates_tables_and_a_private_file_that_commands_take(server_url: str, tmp_path: Path) -> None:
    path = tmp_path / "home" / "lab.toml"
    with pytest.raises(ConfigurationError, match="--create"):
        connect(server_url, path, namespace="connected")
    assert not path.exists()
    assert connect(server_url, path, name="arm-7", namespace="connected", create=True) == ExitCode.SUCCESS
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    config = read_shared_config(path)
    assert (config.name, config.namespace, config.use_memories_of) == ("arm-7", "connected", ())
    assert verify(ledger=path) == ExitCode.SUCCESS
    with pytest.raises(UsageError, match="exists already"):
        connect(server_url, path, name="arm-7", namespace="connected")


@pytest.mark.parametrize(
    ("file", "name", "match"), [("lab.sqlite", "a", "ends in .toml"), ("lab.toml", "a/b", "letters, digits")]
)
def test_a_wrong_file_or_name_is_refused(server_url: str, tmp_path: Path, file: str, name: str, match: str) -> None:
    with pytest.raises(UsageError, match=match):
        connect(server_url, tmp_path / file, name=name, create=True)


def test_without_the_client_library_the_remedy_is_named(
    server_url: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replicated_store, "find_spec", lambda name: None)
    with pytest.raises(MissingDependencyError, match=r"pip install 'dualbrain\[postgres\]'"):
        connect(server_url, tmp_path / "lab.toml")


@pytest.mark.parametrize(
    ("text", "match"),
    [
        ("url = 'postgresql://h/d'\nname = 'a'\nuse_memory_of = ['b']\n", "use_memory_of"),
        ("name = 'a'\n", "url"),
        ("url = 'postgresql://h/d'\nname = '../a'\n", "name"),
        ("url = 'postgresql://a:secret@h/d'\nname = 'a'\n", r"~/\.pgpass"),
        ("url = 'sqlite:///x'\nname = 'a'\n", "not an address of a PostgreSQL server"),
    ],
    ids=range(5),
)
def test_a_wrong_file_of_a_shared_ledger_is_refused(tmp_path: Path, text: str, match: str) -> None:
    path = tmp_path / "lab.toml"
    with pytest.raises(MissingDependencyError, match="dualbrain memory connect"):
        LedgerReader(path)
    path.write_text(text, "utf-8")
    with pytest.raises(ConfigurationError, match=match) as raised:
        LedgerReader(path)
    assert "secret" not in str(raised.value)


def test_a_role_with_the_documented_grants_appends_and_changes_nothing_else(lab: Lab) -> None:
    role = f"robot_{lab.namespace}"
    execute = lab.store.connection.execute
    execute(f"CREATE ROLE {role} LOGIN".encode())
    for statement in GRANTS:
        execute(statement.format(schema=lab.namespace, role=role).encode())
    url = lab.url.replace("postgres:@", f"{role}@")
    with lab.open("one", url=url) as ledger:
        assert not open_memory(ledger).store(episode("e"), REST_POSTURE, now=NOW).is_waiting
    store = PostgresStore.open(url, lab.namespace)
    try:
        for statement in ("UPDATE {}.event SET time = 0", "DELETE FROM {}.embedding", "TRUNCATE {}.event"):
            with pytest.raises(psycopg.errors.InsufficientPrivilege):
                store.connection.execute(statement.format(lab.namespace).encode())
        with pytest.raises(psycopg.errors.InsufficientPrivilege):
            store.connection.execute(f"ALTER TABLE {lab.namespace}.event DISABLE TRIGGER ALL".encode())
    finally:
        store.close()


def test_a_name_under_which_a_robot_has_written_is_refused(lab: Lab, tmp_path: Path) -> None:
    with lab.open("arm-7") as ledger:
        ledger.start_run("a", {}, now=NOW)
    for name in ("arm", "arm-70"):
        assert connect(lab.url, tmp_path / f"{name}.toml", name=name, namespace=lab.namespace) == ExitCode.SUCCESS
    with pytest.raises(UsageError, match=r"under the name arm-7.*arm-7/a.*--same-robot"):
        connect(lab.url, tmp_path / "again.toml", name="arm-7", namespace=lab.namespace)
    assert not (tmp_path / "again.toml").exists()
    path = tmp_path / "new_disk.toml"
    assert connect(lab.url, path, name="arm-7", namespace=lab.namespace, same_robot=True) == ExitCode.SUCCESS
