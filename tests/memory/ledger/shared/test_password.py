"""A role with a password: libpq reads it from the password file; without it the error names the file."""

from collections.abc import Iterator
from pathlib import Path

import psycopg
import pytest
from psycopg.conninfo import conninfo_to_dict, make_conninfo

from dualbrain.cli.memory.connect import connect
from dualbrain.memory.ledger.store import ServerUnreachableError
from tests.memory.ledger.shared.robots import Lab
from tests.memory.ledger.shared.test_connect import GRANTS
from tests.memory.memory_samples import NOW, REST_POSTURE, episode, open_memory

ROLE, PASSWORD = "guarded_robot", "a secret of the lab"


@pytest.fixture
def guarded_url(lab: Lab) -> Iterator[str]:
    """The address of the server for a role whose password the server checks."""
    with psycopg.connect(lab.url, autocommit=True) as owner:
        owner.execute(f"CREATE ROLE {ROLE} LOGIN PASSWORD '{PASSWORD}'".encode())
        for statement in GRANTS:
            owner.execute(statement.format(schema=lab.namespace, role=ROLE).encode())
        (rules,) = owner.execute("SHOW hba_file").fetchone() or ("",)
        before = Path(rules).read_text("utf-8")
        Path(rules).write_text(f"local all {ROLE} scram-sha-256\n{before}", "utf-8")
        owner.execute("SELECT pg_reload_conf()")
        yield make_conninfo(lab.url, user=ROLE)
        Path(rules).write_text(before, "utf-8")
        owner.execute("SELECT pg_reload_conf()")
        owner.execute(f"DROP OWNED BY {ROLE}".encode())
        owner.execute(f"DROP ROLE {ROLE}".encode())


@pytest.fixture
def password_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """An empty password file that libpq reads."""
    path = tmp_path / "pgpass"
    path.touch(mode=0o600)
    monkeypatch.setenv("PGPASSFILE", str(path))
    monkeypatch.delenv("PGPASSWORD", raising=False)
    return path


def test_the_password_comes_from_the_password_file_only(lab: Lab, guarded_url: str, password_file: Path) -> None:
    database = conninfo_to_dict(guarded_url)["dbname"]
    file = lab.folder / "guarded.toml"
    for line in ("", f"*:*:{database}:{ROLE}:another word\n"):
        password_file.write_text(line, "utf-8")
        with pytest.raises(ServerUnreachableError, match=r"refuses the login: .*~/\.pgpass") as refused:
            connect(guarded_url, file, name="arm-7", namespace=lab.namespace)
        assert "another word" not in str(refused.value)
    assert not file.exists()
    password_file.write_text(f"*:*:{database}:{ROLE}:{PASSWORD}\n", "utf-8")
    connect(guarded_url, file, name="arm-7", namespace=lab.namespace)
    assert PASSWORD not in file.read_text("utf-8")


def test_a_robot_whose_password_is_wrong_stores_locally_and_catches_up(
    lab: Lab, guarded_url: str, password_file: Path
) -> None:
    database = conninfo_to_dict(guarded_url)["dbname"]
    right = f"*:*:{database}:{ROLE}:{PASSWORD}\n"
    password_file.write_text(right, "utf-8")
    lab.open("arm-7", url=guarded_url).close()
    password_file.write_text(right.replace("secret", "wrong"), "utf-8")
    with lab.open("arm-7", url=guarded_url) as ledger:
        report = open_memory(ledger).store(episode("one"), REST_POSTURE, now=NOW)
        assert report.is_waiting
        assert "password authentication failed" in str(report)
    assert lab.store.head().seq == 0
    password_file.write_text(right, "utf-8")
    with lab.open("arm-7", url=guarded_url) as ledger:
        open_memory(ledger)
    assert lab.store.head().seq > 0
