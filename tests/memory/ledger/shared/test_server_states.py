"""States of a server that pass: episodes wait, retrieval continues, and no waiting item is put away."""

from collections.abc import Callable, Iterator
from pathlib import Path

import psycopg
import pytest

from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.ledger.ledger import PendingEvent
from dualbrain.memory.ledger.postgres.connection import translated_errors
from dualbrain.memory.ledger.shared import replicated_store
from dualbrain.memory.ledger.shared.spool import Spool
from dualbrain.memory.ledger.store import RefusedEntryError, ServerUnreachableError
from dualbrain.memory.memory import Memory
from tests.memory.ledger.shared.robots import Lab
from tests.memory.ledger.shared.test_connect import GRANTS
from tests.memory.ledger.shared.test_shared_memory import names, recall
from tests.memory.memory_samples import NOW, REST_POSTURE, episode, open_ledger, open_memory


@pytest.mark.parametrize(
    ("error", "access_refused"),
    [
        (psycopg.errors.ReadOnlySqlTransaction, True),
        (psycopg.errors.InsufficientPrivilege, True),
        (psycopg.errors.IdleInTransactionSessionTimeout, False),
        (psycopg.errors.TransactionTimeout, False),
        (psycopg.errors.AdminShutdown, False),
    ],
)
def test_a_state_that_passes_is_no_damage_of_the_ledger(error: type[psycopg.Error], access_refused: bool) -> None:
    with pytest.raises(ServerUnreachableError, match="the answer of the server") as raised, translated_errors():
        raise error("the answer of the server")
    assert raised.value.access_refused == access_refused


@pytest.fixture
def role(lab: Lab) -> Iterator[str]:
    """A role with the grants of a robot."""
    name, execute = f"robot_{lab.namespace}", lab.store.connection.execute
    execute(f"CREATE ROLE {name} LOGIN".encode())
    for statement in GRANTS:
        execute(statement.format(schema=lab.namespace, role=name).encode())
    yield name
    execute(f"DROP OWNED BY {name}".encode())
    execute(f"DROP ROLE {name}".encode())


@pytest.mark.parametrize(
    ("begin", "end"),
    [
        ("REVOKE INSERT ON {schema}.event FROM {role}", "GRANT INSERT ON {schema}.event TO {role}"),
        (
            "ALTER ROLE {role} SET default_transaction_read_only TO on",
            "ALTER ROLE {role} RESET default_transaction_read_only",
        ),
        ("REVOKE SELECT ON {schema}.event FROM {role}", "GRANT SELECT ON {schema}.event TO {role}"),
    ],
    ids=["no_insert", "read_only", "no_select"],
)
def test_while_the_server_refuses_the_access_episodes_wait_and_retrieval_continues(
    lab: Lab, role: str, begin: str, end: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(replicated_store, "RETRY_INTERVAL_S", 0.0)
    url = lab.url.replace("postgres:@", f"{role}@")
    with lab.open("one", url=url) as ledger:
        open_memory(ledger).store(episode("e0"), REST_POSTURE, now=NOW)
    lab.store.connection.execute(begin.format(schema=lab.namespace, role=role).encode())
    with lab.open("one", url=url) as ledger:
        memory = open_memory(ledger)
        for number in (1, 2):
            report = memory.store(episode(f"e{number}", recall=recall(memory)), REST_POSTURE, now=NOW + number)
            assert report.is_waiting
            assert names(recall(memory)) == ["one/e0"]
        ledger.start_run("r", {}, now=NOW + 3)
        assert (len(ledger.spool), ledger.notices) == (3, ())
        lab.store.connection.execute(end.format(schema=lab.namespace, role=role).encode())
        recall(memory)  # a failed append has closed the connection
        assert names(recall(memory)) == ["one/e0", "one/e1", "one/e2"]
        assert (len(ledger.spool), ledger.notices) == (0, ())
        assert [path.name for path in ledger.spool.folder.iterdir()] == []


def test_an_item_that_this_configuration_cannot_store_waits_and_holds_back_no_other(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    with lab.open("one") as ledger:
        memory = open_memory(ledger)
        with monkeypatch.context() as away:
            away.setattr(Memory, "_store", _unreachable)
            memory.store(episode("foreign", robot="unknown"), Posture((0.0,), 0.0), now=NOW)
            memory.store(episode("own"), REST_POSTURE, now=NOW)
        for _ in range(2):
            assert names(recall(memory)) == ["one/own"]
        assert len(ledger.spool) == 1
        (notice,) = ledger.notices
        assert "An item still waits" in notice
        assert "unknown" in notice


def _unreachable(*_: object, **__: object) -> None:
    raise ServerUnreachableError("a test")


def test_a_name_that_exists_is_a_refusal(tmp_path: Path) -> None:
    with open_ledger(tmp_path) as ledger:
        entry = PendingEvent(kind="episode", subject="e", payload={})
        ledger.append([entry], now=NOW)
        with pytest.raises(RefusedEntryError, match="already contains"):
            ledger.append([entry], now=NOW)


class Killed(BaseException):
    """The end of a process at this place."""


def test_a_process_killed_after_the_commit_of_waiting_items_stores_them_once(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    with lab.open("one") as ledger:
        memory = open_memory(ledger)
        with monkeypatch.context() as away:
            away.setattr(replicated_store.ReplicatedStore, "append", _unreachable)
            ledger.start_run("r", {}, now=NOW)
            ledger.mark_progress("plan", now=NOW)
            memory.store(episode("e"), REST_POSTURE, now=NOW)
    for n_removals in (0, 1, 1):
        with lab.open("one") as ledger, monkeypatch.context() as killed:
            killed.setattr(Spool, "remove", _killed_after(n_removals))
            with pytest.raises(Killed):
                open_memory(ledger)
    with lab.open("one") as ledger:
        open_memory(ledger)
        assert (len(ledger.spool), ledger.notices) == (0, ())
        kinds = [event.kind for event in ledger.events() if event.kind != "weight"]
        assert kinds == ["run_started", "run_marked", "episode"]


def _killed_after(n_removals: int) -> Callable[[Spool, Path], None]:
    remove, done = Spool.remove, list[Path]()

    def remove_or_die(spool: Spool, file: Path) -> None:
        if len(done) == n_removals:
            raise Killed
        done.append(file)
        remove(spool, file)

    return remove_or_die
