"""The commands of memory, on a ledger of synthetic episodes: output, exit codes, and edits that can be undone."""

import json
import shutil
import sqlite3

import pytest

from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.memory import open_memory
from dualbrain.cli.memory.open_memory import load_encoder, posture_limits
from dualbrain.grounding.vocabulary import load_skill_registry
from dualbrain.memory.config import MemoryConfig
from dualbrain.memory.embedding.posture_features import Posture
from dualbrain.memory.ledger.ledger import Ledger
from dualbrain.memory.memory import Memory
from dualbrain.robots.interface import home_state
from dualbrain.robots.loader import load_robot
from tests.memory.memory_samples import NOW, episode
from tests.stories.story_session import GRASP, PLACE, contract_text, hold_contract, run_config, run_session

pytestmark = pytest.mark.llm

PLAN = json.loads(contract_text(("grasp", GRASP), ("place", PLACE)))
LONG = "20261121T180000Z-put-the-red-cube-in-the-blue-bowl"
SOURCE = "qwen2.5-coder-1.5b-instruct with an adapter of a long name"


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """A ledger with three successes and one failure that contradicts them."""
    path = tmp_path_factory.mktemp("home") / "ledger.sqlite"
    home = home_state(load_robot("panda"))
    with Ledger(path, holder="a test", now=NOW) as ledger:
        memory = Memory(ledger, load_encoder(), MemoryConfig(limits=posture_limits("panda")))
        for name, kind in (("a", "succeeded"), ("b", "succeeded"), (LONG, "succeeded"), ("odd", "failed")):
            one = episode(
                name,
                kind,
                robot="panda",
                registry=load_skill_registry("panda").hash,
                plan=PLAN,
                Delta=0.001,
                proposer=f"{SOURCE} {name}",
            )
            memory.store(one, Posture(tuple(home.q.tolist()), home.opening), now=NOW)
    return path


@pytest.fixture
def filled(made, tmp_path):
    """A copy of it, to be changed."""
    return shutil.copy(made, tmp_path / "ledger.sqlite")


@pytest.fixture
def ask(run_command, filled):
    """`dualbrain memory … --json`; returns (exit code, the printed object)."""

    def run(*words):
        code, out, _ = run_command("memory", *words, "--ledger", filled, "--json")
        return code, json.loads(out)

    return run


def _weights(ask):
    return {row["id"]: (row["weight"], row["status"]) for row in ask("list")[1]["memories"]}


def test_memories_are_listed_shown_and_searched(ask):
    code, data = ask("list", "--outcome", "succeeded", "--limit", "2")
    assert (code, [row["id"] for row in data["memories"]], data["total"]) == (ExitCode.SUCCESS, [LONG, "b"], 3)
    assert ask("list", "--at", "1")[1]["total"] == 1
    assert ask("show", "a")[1]["memo"]["provenance"]["skills"] == ["grasp", "place"]
    found = ask("search", "put the red cube in the bowl", "--scene", "bare:0", "--k", "2")[1]
    assert [hit["rank"] for hit in found["exemplars"]] == [1, 2]
    assert set(found["exemplars"][0]["parts"]) >= {"instruction", "summary", "state"}
    assert ask("verify", "--vectors")[1] | {"chain": None} == {
        "whole": True,
        "memories": 4,
        "snapshot": "none",
        "vectors": {"checked": 4, "without_digest": 0, "faults": {}},
        "vectors_wrong": 0,
        "anchors_compared": 0,
        "anchor_faults": [],
        "file_faults": [],
        "notices": [],
        "chain": None,
    }


def test_names_can_be_copied_from_a_narrow_listing(run_command, filled, monkeypatch):
    monkeypatch.setenv("COLUMNS", "80")
    code, out, _ = run_command("memory", "list", "--ledger", filled)
    assert code == ExitCode.SUCCESS
    (row,) = (line for line in out.splitlines() if LONG in line)
    assert row.rstrip().endswith(f"{SOURCE} {LONG}")
    out = run_command("memory", "search", "put the red cube in the bowl", "--scene", "bare:0", "--ledger", filled)[1]
    assert sum(LONG in line for line in out.splitlines()) == 1
    assert run_command("memory", "show", LONG, "--ledger", filled)[1].startswith(
        f"{LONG}: put the red cube in the bowl\n"
    )


def test_changes_can_be_rolled_back(ask):
    before, (code, report) = _weights(ask), ask("audit")
    assert (code, {one["memory"] for one in report["findings"]}) == (ExitCode.FAILED_SAFELY, {"odd"})
    assert ask("quarantine", "odd", "--reason", "contradicted")[0] == ExitCode.SUCCESS
    after = _weights(ask)
    assert after["odd"][1] == "quarantined"
    assert all(after[name][0] > before[name][0] for name in ("a", "b", LONG))
    assert ask("audit")[0] == ExitCode.SUCCESS
    ask("release", "odd", "--reason", "a mistake")
    assert _weights(ask) == before
    mark = ask("list")[1]["event"]
    ask("forget", "a", "--reason", "asked for")
    assert _weights(ask)["a"][1] == "forgotten"
    ask("rollback", mark, "--reason", "not meant")
    assert _weights(ask) == before
    assert ask("compact")[1]["after"] > 0
    assert _weights(ask) == before
    assert ask("rebuild")[1] == {"vectors": 4}
    assert ask("verify")[1]["snapshot"] == "agrees"


def test_memories_are_exported_as_lines(run_command, filled, tmp_path):
    code, out, _ = run_command("memory", "export", "--ledger", filled)
    assert code == ExitCode.SUCCESS
    assert [json.loads(line)["id"] for line in out.splitlines()] == ["a", "b", LONG, "odd"]
    assert run_command("memory", "export", tmp_path / "all.jsonl", "--ledger", filled)[0] == ExitCode.SUCCESS
    assert (tmp_path / "all.jsonl").read_text() == out
    code, out, err = run_command("memory", "export", tmp_path / "all.jsonl", "--ledger", filled)
    assert (code, out) == (ExitCode.SETUP, "")
    assert "all.jsonl exists already. Name a new file" in err


def test_an_audit_and_a_replay_are_written_down_if_wanted(run_command, filled, ask):
    head = ask("list")[1]["event"]
    assert run_command("memory", "audit", "--ledger", filled)[0] == ExitCode.FAILED_SAFELY
    assert ask("list")[1]["event"] == head
    code, out, err = run_command("memory", "audit", "--note", "--ledger", filled)
    assert code == ExitCode.FAILED_SAFELY
    assert "label conflict: odd: " in out
    assert "1 finding in 4 memories" in err
    assert ask("list")[1]["event"] == head + 1

    code, data = ask(
        "replay", "a", "--tries", "2", "--no-note"
    )  # its scene contained no object, so the gate rejects the contract
    assert (code, data["agrees"], data["outcomes"]) == (ExitCode.FAILED_SAFELY, False, ["refused", "refused"])
    assert ask("list")[1]["event"] == head + 1
    assert ask("replay", "odd", "--tries", "1")[0] == ExitCode.SUCCESS
    assert ask("show", "odd")[1]["history"][-1]["kind"] == "replayed"


def test_a_memory_of_a_real_run_is_confirmed_when_it_is_replayed(run_command, tmp_path):
    config = run_config(tmp_path, "one", instruction="rest a little")
    run_session(config, hold_contract(0.5))
    code, out, err = run_command("memory", "replay", "one", "--tries", "1", "--ledger", config.ledger)
    assert (code, out) == (ExitCode.SUCCESS, "")
    assert "one (succeeded): confirmed; 1 of 1 tries ended as remembered" in err


NOT_THERE = "is not a memory of this ledger"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("show", "nothing"), NOT_THERE),
        (("replay", "nothing"), NOT_THERE),
        (("quarantine", "nothing", "--reason", "x"), NOT_THERE),
        (("release", "nothing", "--reason", "x"), NOT_THERE),
        (("forget", "a", "nothing", "--reason", "x"), NOT_THERE),
        (("forget", "--reason", "x"), "No memory was named. List the ids with `dualbrain memory list`."),
        (("forget", "a", "--reason", " "), "The reason is empty. State a reason with --reason."),
        (("quarantine", "--source", "elsewhere", "--reason", "x"), "No memory has the source 'elsewhere'."),
        (("release", "--source", "elsewhere", "--reason", "x"), "No memory has the source 'elsewhere'."),
        (("rollback", "9999", "--reason", "x"), "rollback target: got 9999"),
        (("replay", "a", "--tries", "0"), "tries: got 0"),
        (("list", "--at", "yesterday"), "time: got 'yesterday', allowed: ISO 8601"),
        (("list", "--at", "²"), "time: got '²', allowed: ISO 8601"),
        (("list", "--at", "9" * 5000), "time: got '9999"),
    ],
)
def test_an_impossible_request_is_reported_and_changes_nothing(run_command, filled, words, message):
    before = _events(filled)
    code, out, err = run_command("memory", *words, "--ledger", filled)
    assert (code, out) == (ExitCode.SETUP, "")
    assert message in err
    assert _events(filled) == before


def _events(path):
    with sqlite3.connect(path) as database:
        return database.execute("SELECT hash FROM event ORDER BY seq").fetchall()


def test_a_ledger_that_is_not_there_is_not_made(run_command, tmp_path):
    for words in (("rebuild",), ("list",), ("compact",), ("forget", "a", "--reason", "x")):
        code, out, err = run_command("memory", *words, "--ledger", tmp_path / "none.sqlite")
        assert (code, out) == (ExitCode.SETUP, "")
        assert "The first `dualbrain run` creates it" in err
        assert not list(tmp_path.glob("none*"))


def test_a_changed_event_is_found_and_memory_refused(run_command, filled):
    with sqlite3.connect(filled) as database:
        database.execute("DROP TRIGGER event_is_never_changed")
        database.execute("UPDATE event SET payload = replace(payload, 'red cube', 'red cub3') WHERE seq = 1")
    code, out, err = run_command("memory", "verify", "--ledger", filled, "--json")
    assert (code, json.loads(out)["whole"]) == (ExitCode.FAILED_SAFELY, False)
    assert "broken at 1: its content does not match its hash" in err
    code, out, err = run_command("memory", "audit", "--ledger", filled)
    assert (code, out) == (ExitCode.SETUP, "")
    assert "its content does not match its hash" in err


def test_a_file_that_is_not_a_ledger_is_reported(run_command, tmp_path):
    (tmp_path / "words.sqlite").write_text("words of a person, " * 100)
    for words in (("list",), ("verify",), ("compact",)):
        code, out, err = run_command("memory", *words, "--ledger", tmp_path / "words.sqlite")
        assert (code, out) == (ExitCode.SETUP, "")
        assert "file is not a database" in err


def test_who_writes_is_named_and_reading_goes_on(run_command, filled, monkeypatch):
    monkeypatch.setattr(open_memory, "LOCK_TIMEOUT_S", 0.0)
    with Ledger(filled, holder="dualbrain run tuesday", now=NOW):
        code, out, err = run_command("memory", "forget", "a", "--reason", "x", "--ledger", filled)
        assert (code, out) == (ExitCode.SETUP, "")
        assert "(dualbrain run tuesday)" in err
        assert run_command("memory", "list", "--ledger", filled)[0] == ExitCode.SUCCESS
    assert run_command("memory", "forget", "a", "--reason", "x", "--ledger", filled)[0] == ExitCode.SUCCESS


def test_a_changed_vector_and_a_lost_event_are_reported_without_recomputing(ask, run_command, filled):
    ask("quarantine", "odd", "--reason", "a test")  # leaves an anchor
    with sqlite3.connect(filled) as database:
        database.execute("UPDATE vector SET data = zeroblob(length(data)) WHERE seq = (SELECT min(seq) FROM vector)")
    database.close()
    code, found = ask("verify")
    assert (code, found["whole"], list(found["vectors"]["faults"].values())) == (1, False, ["its vector was changed"])
    ask("rebuild")
    assert ask("verify")[0] == 0
    with sqlite3.connect(filled) as database:
        (trigger,) = database.execute("SELECT sql FROM sqlite_master WHERE name = 'event_is_never_removed'").fetchone()
        database.execute("DROP TRIGGER event_is_never_removed")
        database.execute("DELETE FROM event WHERE seq = (SELECT max(seq) FROM event)")
        database.execute(trigger)
    database.close()
    code, found = ask("verify")
    assert (code, found["chain"]["broken_at"], len(found["anchor_faults"])) == (1, None, 1)
    code, _, err = run_command("memory", "release", "odd", "--reason", "a test", "--ledger", str(filled))
    assert code == 5
    assert "its newest events are missing" in err
    assert ask("verify", "--accept", "a restored backup")[0] == 0
    assert ask("verify")[0] == 0
