"""Memories of several robots on one ledger: equal weights, whose memories are used, a server that is away."""

import socket
import threading
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from dualbrain.errors import ConfigurationError
from dualbrain.memory.index import engine_index
from dualbrain.memory.index.engine_index import EngineIndex
from dualbrain.memory.index.engines.pgvector import PgvectorEngine
from dualbrain.memory.ledger.hash_chain import CorruptLedgerError
from dualbrain.memory.ledger.ledger import Ledger, LedgerReader, StoredVector
from dualbrain.memory.ledger.shared import replicated_store
from dualbrain.memory.ledger.store import EventQuery, ServerUnreachableError
from dualbrain.memory.maintenance.compaction import compact_in_place
from dualbrain.memory.maintenance.edits import quarantine
from dualbrain.memory.maintenance.verification import verify
from dualbrain.memory.memory import Memory
from dualbrain.memory.state.derivation import derive_state
from dualbrain.records import RetrievedContext
from tests.memory.ledger.shared.robots import Lab
from tests.memory.memory_samples import NOW, REST_POSTURE, episode, open_ledger, open_memory


def recall(memory: Memory) -> RetrievedContext:
    return memory.retrieve("put the red cube in the bowl", "neighbour_across low", REST_POSTURE, "arm", "aaaa1111", k=5)


def names(found: RetrievedContext) -> list[str]:
    return sorted(hit.episode_id for hit in found.exemplars)


class Proxy:
    """A TCP server in front of the Unix socket of the database; `cut` drops its connections and refuses new ones."""

    def __init__(self, path: str) -> None:
        self.target, self.is_cut, self.is_silent = path, False, False
        self.pairs: list[socket.socket] = []
        self.server = socket.create_server(("127.0.0.1", 0))
        self.url = f"postgresql://postgres@127.0.0.1:{self.server.getsockname()[1]}/postgres"
        threading.Thread(target=self.serve, daemon=True).start()

    def serve(self) -> None:
        while True:
            try:
                client, _ = self.server.accept()
            except OSError:
                return
            if self.is_cut:
                client.close()
                continue
            upstream = socket.socket(socket.AF_UNIX)
            upstream.connect(self.target)
            self.pairs += [client, upstream]
            for one, other in ((client, upstream), (upstream, client)):
                threading.Thread(target=self.copy, args=(one, other), daemon=True).start()

    def copy(self, one: socket.socket, other: socket.socket) -> None:
        with suppress(OSError):
            while data := one.recv(1 << 16):
                if not self.is_silent:
                    other.sendall(data)

    def cut(self) -> None:
        self.is_cut = True
        for one in self.pairs:
            with suppress(OSError):
                one.shutdown(socket.SHUT_RDWR)
            one.close()
        self.pairs.clear()

    def restore(self) -> None:
        self.is_cut = self.is_silent = False


@pytest.fixture
def proxy(lab: Lab, monkeypatch: pytest.MonkeyPatch) -> Iterator[Proxy]:
    monkeypatch.setattr(replicated_store, "RETRY_INTERVAL_S", 0.0)
    info = lab.store.connection.info
    opened = Proxy(f"{info.host}/.s.PGSQL.{info.port}")
    yield opened
    opened.cut()
    opened.server.close()


@contextmanager
def two_memories(lab: Lab) -> Iterator[tuple[Memory, Memory]]:
    with lab.open("one") as first, lab.open("two") as second:
        yield open_memory(first), open_memory(second)


def test_the_same_episodes_give_the_same_chain_and_weights_as_a_ledger_file(lab: Lab, tmp_path: Path) -> None:
    heads, weights = [], []
    for ledger in (open_ledger(tmp_path), lab.open("one")):
        with ledger:
            memory = open_memory(ledger)
            ledger._run = "run"
            ledger.qualify = lambda name: name
            for i in range(4):
                memory.store(episode(f"e{i}", recall=recall(memory)), REST_POSTURE, now=NOW + i)
            heads.append(ledger.head())
            weights.append(memory.weights())
    assert heads[0] == heads[1] == lab.store.head()
    assert weights[0] == weights[1]


def test_robots_that_store_in_turn_agree_on_chain_weights_and_recall(lab: Lab) -> None:
    with two_memories(lab) as memories:
        for i in range(6):
            memory = memories[i % 2]
            memory.store(episode(f"e{i}", recall=recall(memory)), REST_POSTURE, now=NOW + i)
        one, two = (recall(memory) for memory in memories)
        assert one == two
        assert names(one)[:2] == ["one/e2", "one/e4"]
        assert memories[0].weights() == memories[1].weights() == derive_state(memories[0].ledger).weights()
        assert verify(memories[0].ledger).is_intact
        assert memories[0].ledger.head() == lab.store.head()


def test_an_edit_of_one_robot_changes_the_weights_of_the_other(lab: Lab) -> None:
    with two_memories(lab) as (first, second):
        for i in range(3):
            first.store(episode(f"e{i}", recall=recall(first)), REST_POSTURE, now=NOW + i)
        assert len(recall(second).exemplars) == 3
        quarantine(first, ["one/e1"], "a test", now=NOW + 9)
        assert names(recall(second)) == ["one/e0", "one/e2"]
        assert first.weights() == second.weights()


def test_outcomes_of_a_slow_robot_are_computed_again_and_at_last_the_others_wait(
    lab: Lab, monkeypatch: pytest.MonkeyPatch
) -> None:
    with two_memories(lab) as (slow, fast):
        slow.store(episode("e"), REST_POSTURE, now=NOW)
        build, counts = Memory._store_once, [0]

        def interrupted(self: Memory, *args: object, **settings: object) -> object:
            if self is slow and counts[0] < 3:
                counts[0] += 1
                fast.store(episode(f"f{counts[0]}", recall=recall(fast)), REST_POSTURE, now=NOW)
            return build(self, *args, **settings)

        monkeypatch.setattr(Memory, "_store_once", interrupted)
        slow.store(episode("late", recall=recall(slow)), REST_POSTURE, now=NOW)
        recall(fast)
        assert counts == [3]
        assert list(slow.weights())[-1] == "slow/late".replace("slow", "one")
        assert slow.weights() == fast.weights() == derive_state(slow.ledger).weights()


def test_only_memories_of_the_named_robots_are_retrieved(lab: Lab) -> None:
    with two_memories(lab) as (first, second):
        first.store(episode("a"), REST_POSTURE, now=NOW)
        second.store(episode("b"), REST_POSTURE, now=NOW)
    with lab.open("three", use_memories_of=("two",)) as third, lab.open("four") as fourth:
        assert names(recall(open_memory(third))) == ["two/b"]
        assert names(recall(open_memory(fourth))) == ["one/a", "two/b"]


def test_runs_of_robots_with_the_same_name_are_different_and_only_own_runs_are_interrupted(lab: Lab) -> None:
    for name in ("one", "two"):
        with lab.open(name) as ledger:
            assert ledger.start_run("r", {}, now=NOW) == ()
    with lab.open("one") as ledger:
        assert [run.run for run in ledger.interrupted_runs()] == ["one/r"]


# --- a server that is away ------------------------------------------------------------------------------------------


def test_without_a_server_the_robot_continues_and_nothing_is_lost_or_stored_twice(lab: Lab, proxy: Proxy) -> None:
    with lab.open("one", url=proxy.url) as ledger, lab.open("two") as other:
        memory, second = open_memory(ledger), open_memory(other)
        memory.store(episode("e0"), REST_POSTURE, now=NOW)
        proxy.cut()
        ledger.start_run("r", {}, now=NOW)
        assert names(recall(memory)) == ["one/e0"]
        report = memory.store(episode("e1", recall=recall(memory)), REST_POSTURE, now=NOW + 1)
        assert report.is_waiting
        with pytest.raises(ServerUnreachableError, match="does not answer"):
            quarantine(memory, ["one/e0"], "a test", now=NOW)
        ledger.end_run({}, now=NOW + 2)
        assert len(ledger.spool) == 3
        second.store(episode("f", recall=recall(second)), REST_POSTURE, now=NOW + 3)
    with lab.open("one", url=proxy.url) as ledger:  # after a restart of the robot, still without the server
        memory = open_memory(ledger)
        assert names(recall(memory)) == ["one/e0"]
        proxy.restore()
        found = recall(memory)
        assert ledger.notices == ()
        assert names(found) == ["one/e0", "one/e1", "two/f"]
        assert len(ledger.spool) == 0
        assert ledger.interrupted_runs() == ()
        kinds = [(event.kind, event.run) for event in ledger.events() if event.kind != "weight"]
        assert kinds == [
            ("episode", "one/"),
            ("episode", "two/"),
            ("run_started", "one/r"),
            ("episode", "one/r"),
            ("run_ended", "one/r"),
        ]
        assert memory.weights() == derive_state(ledger).weights()
        assert verify(ledger).is_intact


def test_an_append_whose_answer_is_lost_is_stored_once(lab: Lab, proxy: Proxy, monkeypatch: pytest.MonkeyPatch) -> None:
    with lab.open("one", url=proxy.url) as ledger:
        memory = open_memory(ledger)
        store = ledger._store._connected()
        real = store._insert

        def insert_and_lose_the_answer(chained: object) -> None:
            real(chained)
            store.connection.execute("COMMIT")  # the server commits, and the connection dies before the answer
            proxy.cut()

        monkeypatch.setattr(store, "_insert", insert_and_lose_the_answer)
        assert memory.store(episode("e"), REST_POSTURE, now=NOW).is_waiting
        ledger.start_run("r", {}, now=NOW)
        proxy.restore()
        assert names(recall(memory)) == ["one/e"]
        assert len(ledger.spool) == 0
        assert ledger.notices == ()
        assert [event.kind for event in ledger.events()].count("episode") == 1
        assert ledger.head() == lab.store.head()


def test_a_run_whose_end_waits_is_not_interrupted(lab: Lab, proxy: Proxy) -> None:
    with lab.open("one", url=proxy.url) as ledger:
        ledger.start_run("r", {}, now=NOW)
        proxy.cut()
        ledger.end_run({}, now=NOW)
    with lab.open("one", url=proxy.url) as ledger:
        assert ledger.interrupted_runs() == ()


def test_vectors_that_one_robot_recomputes_reach_the_others(lab: Lab) -> None:
    with two_memories(lab) as (first, second):
        first.store(episode("e"), REST_POSTURE, now=NOW)
        recall(second)
        assert isinstance(first.ledger, Ledger)
        old = dict(first.ledger.vectors())[1]
        negative = (-np.frombuffer(old.data, "<f4")).astype("<f4")
        first.ledger.replace_vectors({1: StoredVector(old.version, negative.tobytes(), old.mask)})
        recall(second)
        assert dict(second.ledger.vectors()) == dict(first.ledger.vectors())
        assert np.array_equal(second.index.rows[0], negative)


def test_a_silent_server_is_given_up_after_a_time(lab: Lab, proxy: Proxy, monkeypatch: pytest.MonkeyPatch) -> None:
    from dualbrain.memory.ledger.postgres import connection  # noqa: PLC0415

    with lab.open("one", url=proxy.url) as ledger:
        memory = open_memory(ledger)
        monkeypatch.setattr(connection, "STATEMENT_TIMEOUT_S", 0.2)
        monkeypatch.setattr(replicated_store, "RETRY_INTERVAL_S", 60.0)
        proxy.is_silent = True
        assert memory.store(episode("e"), REST_POSTURE, now=NOW).is_waiting
        with pytest.raises(ServerUnreachableError, match="a moment ago"):
            ledger._store.pull()


def test_calls_between_two_attempts_do_not_postpone_the_next_one(
    lab: Lab, proxy: Proxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    times = iter(range(100))
    monkeypatch.setattr(replicated_store, "time", SimpleNamespace(monotonic=lambda: float(next(times))))
    monkeypatch.setattr(replicated_store, "RETRY_INTERVAL_S", 5.0)
    with lab.open("one", url=proxy.url) as ledger:
        memory = open_memory(ledger)
        proxy.cut()
        assert memory.store(episode("e"), REST_POSTURE, now=NOW).is_waiting
        proxy.restore()
        for _ in range(8):  # each call reads the clock at least once
            with suppress(ServerUnreachableError), ledger._store.exclusive():
                break
        else:
            pytest.fail("no new attempt")


def test_an_episode_that_the_ledger_refuses_is_put_away_with_a_notice(lab: Lab, proxy: Proxy) -> None:
    with lab.open("one", url=proxy.url) as ledger:
        memory = open_memory(ledger)
        proxy.cut()
        for _ in range(2):
            memory.store(episode("same"), REST_POSTURE, now=NOW)
        proxy.restore()
        assert memory.catch_up() > 0
        assert len(ledger.spool) == 0
        assert [path.suffix for path in ledger.spool.folder.iterdir()] == [".refused"]
        assert "already contains an episode 'one/same'" in ledger.notices[-1]


def test_the_first_copy_needs_the_server(lab: Lab, proxy: Proxy) -> None:
    proxy.cut()
    with pytest.raises(ServerUnreachableError):
        lab.open("one", url=proxy.url)
    proxy.restore()
    lab.open("one", url=proxy.url).close()


# --- forged and lost events -----------------------------------------------------------------------------------------


def tamper(lab: Lab, statement: str) -> None:
    table = f"{lab.namespace}.event"
    for one in (f"ALTER TABLE {table} DISABLE TRIGGER USER", statement, f"ALTER TABLE {table} ENABLE TRIGGER USER"):
        lab.store.connection.execute(one.format(lab.namespace).encode())


@pytest.mark.parametrize(
    ("statement", "fault"),
    [
        ("UPDATE {}.event SET payload = payload || ' ' WHERE seq = 3", "does not match its hash"),
        ("UPDATE {}.embedding SET data = data || '0' WHERE seq = 3", "its vector was changed"),
        ("DELETE FROM {}.embedding WHERE seq = 3", "its vector is missing"),
        ("UPDATE {}.event SET hash = md5(hash) WHERE seq = 2", "another one than in this robot's replica"),
        ("TRUNCATE {0}.event, {0}.embedding", "lacks event 2"),
    ],
    ids=["payload", "vector", "no_vector", "old_event", "emptied"],
)
def test_a_follower_refuses_forged_and_missing_events(lab: Lab, statement: str, fault: str) -> None:
    with two_memories(lab) as (first, second):
        first.store(episode("e0"), REST_POSTURE, now=NOW)
        recall(second)
        first.store(episode("e1"), REST_POSTURE, now=NOW)
        tamper(lab, statement)
        with pytest.raises(CorruptLedgerError, match=fault):
            recall(second)
        assert second.ledger.head().seq == 2


def test_verification_reads_the_server_too(lab: Lab) -> None:
    with lab.open("one") as ledger:
        open_memory(ledger).store(episode("e0"), REST_POSTURE, now=NOW)
        tamper(lab, "UPDATE {}.event SET payload = payload || ' ' WHERE seq = 1")
        found = verify(ledger)
        assert not found.is_intact
        assert found.chain.is_intact
        assert "chain on the server is broken at event 1" in found.file_faults[0]


def test_a_reader_follows_while_no_process_writes_and_a_shared_ledger_is_not_compacted(lab: Lab) -> None:
    with two_memories(lab) as (first, _):
        first.store(episode("e0"), REST_POSTURE, now=NOW)
        with LedgerReader(lab.path("two")) as reader:
            assert reader.head().seq == 0
    with LedgerReader(lab.path("two")) as reader:
        assert reader.head() == lab.store.head()
        assert list(reader.events()) == list(lab.store.events(EventQuery()))
    with pytest.raises(ConfigurationError, match="cannot be compacted"):
        compact_in_place(lab.path("two"), holder="a test", now=NOW, timeout_s=0.0)


def test_with_the_index_on_the_server_retrieval_is_that_of_the_scan_also_while_it_is_away(
    lab: Lab, proxy: Proxy, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(engine_index, "FIRST_COUNT", 2)
    with lab.open("scan") as first, lab.open("engine", url=proxy.url, index="pgvector") as second:
        scan = open_memory(first)
        for number in range(40):
            words = f"put the {('red cube', 'mug', 'plate', 'screw')[number % 4]} in the bowl"
            one = episode(f"e-{number}", instruction=words, kind="failed" if number % 3 == 0 else "succeeded")
            scan.store(one, REST_POSTURE, now=NOW + number)
        memory = open_memory(second)
        assert isinstance(memory.index, EngineIndex)
        assert recall(memory) == recall(scan)
        memory.store(episode("e-new"), REST_POSTURE, now=NOW + 100)
        assert recall(memory) == recall(scan)
        proxy.cut()
        assert recall(memory) == recall(scan)
    with lab.open("engine", index="pgvector") as again:
        engine = PgvectorEngine(lab.url, lab.namespace, open_memory(again).embedding.dim)
        seqs, _ = engine.stored()
        engine.close()
        assert len(seqs) == 41
