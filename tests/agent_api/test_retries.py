"""Contracts that are submitted again: found by id and content, for a while, also after a restart."""

import json

import pytest

from dualbrain.agent_api import retries
from dualbrain.agent_api.retries import LOST_REASON, MAX_ID, RETRY_WINDOW, RetryLog, contract_identity
from dualbrain.agent_api.submission import Submission, SubmissionReport
from dualbrain.contracts.verdict import Rejected

NOW = 1_000_000.0
CONTRACT = {"id": "c-0001", "context": {"robot": "panda"}, "action_sequence": [{"skill": "hold"}]}

OTHER_IDS = [json.dumps({"id": one}).encode() for one in ("x" * 60_000, "c-0001\n")]
"""Contracts with ids that are too long, which the gate rejects."""


def submission(state="checking", digest="d", at=NOW):
    return Submission(SubmissionReport(id="c-0001", state=state), digest, at)


def test_the_same_contract_is_the_same_submission():
    log, first = RetryLog(), submission()
    log.add("c-0001", first)
    assert log.find("c-0001", "d", NOW + 1.0) is first
    assert log.find("c-0002", "d", NOW + 1.0) is None


def test_another_contract_with_the_same_id_is_rejected():
    log = RetryLog()
    log.add("c-0001", submission())
    rejected = log.find("c-0001", "other", NOW)
    assert isinstance(rejected, Rejected)
    assert rejected.pointer == "/id"


def test_an_id_is_free_after_the_window_and_after_a_rejection():
    log = RetryLog()
    log.add("c-0001", submission())
    assert log.find("c-0001", "other", NOW + RETRY_WINDOW + 1.0) is None
    log.add("c-0001", submission("rejected"))
    assert log.find("c-0001", "d", NOW) is None
    assert log.find("c-0001", "other", NOW) is None


def test_the_next_id_is_free_and_stays_until_it_is_used():
    log = RetryLog()
    assert log.next_id(NOW) == log.next_id(NOW) == "c-0001"
    log.add("c-0001", submission())
    assert log.next_id(NOW) == "c-0002"
    log.add("c-0003", submission())
    log.add("c-0002", submission())
    assert log.next_id(NOW) == "c-0004"
    assert log.next_id(NOW + RETRY_WINDOW + 1.0) == "c-0004"


def test_old_submissions_are_forgotten_only_beyond_the_window_and_the_number_that_is_kept(monkeypatch):
    monkeypatch.setattr(retries, "MAX_KNOWN", 3)
    log = RetryLog()
    for number in range(6):
        log.add(f"old-{number}", submission("finished"))
    assert log.get("old-0") is not None
    for number in range(2):
        log.add(f"new-{number}", submission(at=NOW + RETRY_WINDOW + 1.0))
    assert [name for name in ("old-0", "old-4", "old-5", "new-0", "new-1") if log.get(name)] == [
        "old-5",
        "new-0",
        "new-1",
    ]


def test_ids_begin_again_after_the_last_one():
    log = RetryLog()
    for number in range(1, MAX_ID + 1):
        log.add(f"c-{number:04d}", submission(at=NOW - RETRY_WINDOW - 1.0 if number == 7 else NOW))
    assert log.next_id(NOW) == "c-0007"


def test_a_restart_remembers_outcomes_and_interrupted_contracts(tmp_path):
    path = tmp_path / "submissions.jsonl"
    log = RetryLog(path, now=NOW)
    finished, interrupted = submission(), submission(digest="e")
    log.add("c-0001", finished)
    finished._update(state="finished")
    log.finish("c-0001", finished)
    log.add("c-0002", interrupted)
    again = RetryLog(path, now=NOW + 5.0)
    assert again.find("c-0001", "d", NOW + 5.0).report.state == "finished"
    lost = again.find("c-0002", "e", NOW + 5.0).report
    assert (lost.state, lost.reason) == ("lost", LOST_REASON)
    assert len(path.read_bytes().splitlines()) == 2
    assert RetryLog(path, now=NOW + 2.0 * RETRY_WINDOW).get("c-0001") is None
    assert path.read_bytes() == b""


def test_lines_that_cannot_be_read_are_left_out(tmp_path):
    path = tmp_path / "submissions.jsonl"
    RetryLog(path, now=NOW).add("c-0001", submission())
    path.write_bytes(path.read_bytes() + b'{"key": "c-0002", "time": "x"}\n{"key": "c-00')
    log = RetryLog(path, now=NOW)
    assert log.get("c-0001") is not None
    assert log.get("c-0002") is None


def test_the_identity_does_not_depend_on_form():
    compact, spread = json.dumps(CONTRACT).encode(), json.dumps(dict(reversed(CONTRACT.items())), indent=2).encode()
    assert contract_identity(compact) == contract_identity(spread)
    assert contract_identity(compact)[0] == "c-0001"
    changed = json.dumps(CONTRACT | {"action_sequence": []}).encode()
    assert contract_identity(changed)[1] != contract_identity(compact)[1]


@pytest.mark.parametrize("data", [b"", b"{", b"[]", b'{"id": 3}', b"\xff", b'{"id":"a","id":"a"}', b"{}", *OTHER_IDS])
def test_a_text_that_is_no_contract_has_no_identity(data):
    assert contract_identity(data) == ("", "")
