"""Shadow mode: a candidate is asked all questions, its answers have no effect, and they are logged."""

import os
import stat
import time
from threading import Event
from types import SimpleNamespace

import pytest

from dualbrain.adaptation.adapters.naming import parse_shadow_name
from dualbrain.adaptation.serving import shadow
from dualbrain.adaptation.serving.open_planner import planner_provenance
from dualbrain.adaptation.serving.shadow import ShadowedPlanner, read_shadow_log, summarize_shadow
from dualbrain.errors import ConfigurationError
from dualbrain.planner import protocol
from dualbrain.planner.introspection import planner_messages, planner_template
from dualbrain.planner.prompt.full_prompt import render, template_hash
from dualbrain.planner.scripted import ScriptedPlanner
from tests.planner.sample_requests import plan_request


def test_the_serving_planner_answers_and_the_candidate_is_logged(tmp_path):
    log = tmp_path / "shadows" / "a.jsonl"
    serving, candidate = ScriptedPlanner(["one", "two"]), ScriptedPlanner(["one", "three"])
    planner = ShadowedPlanner(serving, candidate, log)
    for words, text in (("first", "one"), ("second", "two")):
        assert planner.propose(plan_request(words)).text == text
        planner._thread.join()
    planner.close()
    assert [one.instruction for one in candidate.requests] == ["first", "second"]
    seen = read_shadow_log(log)
    assert [(one.candidate_text, one.is_same) for one in seen] == [("one", True), ("three", False)]
    assert "2 shadow answers: 2 complete, 1 equal to the served answer" in summarize_shadow(seen)


def test_the_log_is_private_with_every_umask(tmp_path):
    log, before = tmp_path / "shadows" / "a.jsonl", os.umask(0)
    try:
        planner = ShadowedPlanner(ScriptedPlanner(["one"]), ScriptedPlanner(["one"]), log)
        planner.propose(plan_request("first"))
        planner._thread.join()
        planner.close()
    finally:
        os.umask(before)
    assert [stat.S_IMODE(path.stat().st_mode) for path in (log.parent, log)] == [0o700, 0o600]


class Slow(ScriptedPlanner):
    """Answers when it is released or closed."""

    def __init__(self, texts):
        super().__init__(texts)
        self.released = Event()

    def propose(self, request):
        self.released.wait(60.0)
        return super().propose(request)

    def close(self):
        self.released.set()


class Raises(ScriptedPlanner):
    def propose(self, request):
        raise OSError("no such thing")


def test_the_robot_never_waits_for_the_candidate_and_skipped_questions_are_counted(tmp_path):
    log = tmp_path / "a.jsonl"
    candidate = Slow(["one", "four"])
    planner = ShadowedPlanner(ScriptedPlanner(["one", "two", "three", "four", "five"]), candidate, log)
    for words in ("first", "second", "third"):
        planner.propose(plan_request(words))  # a wait would outlast the test
    assert read_shadow_log(log) == ()
    candidate.released.set()
    planner._thread.join()
    assert [(one.instruction, one.passed_over) for one in read_shadow_log(log)] == [("first", 2)]
    planner.propose(plan_request("fourth"))
    planner.close()
    assert [(one.instruction, one.is_same, one.passed_over) for one in read_shadow_log(log)][1:] == [
        ("fourth", True, 0)
    ]
    assert "; 2 more questions skipped" in summarize_shadow(read_shadow_log(log))


def test_closing_waits_a_limited_time_for_a_pending_answer(tmp_path, monkeypatch):
    monkeypatch.setattr(shadow, "JOIN_TIMEOUT_S", 0.05)
    planner = ShadowedPlanner(ScriptedPlanner(["one"]), Slow(["one"]), tmp_path / "a.jsonl")
    planner.propose(plan_request())
    start = time.monotonic()
    planner.close()
    planner._thread.join()
    assert time.monotonic() - start < 30.0
    assert len(read_shadow_log(tmp_path / "a.jsonl")) == 1


def test_an_error_of_the_candidate_is_logged_and_summarised(tmp_path):
    log = tmp_path / "a.jsonl"
    planner = ShadowedPlanner(ScriptedPlanner(["one"]), Raises([]), log)
    assert planner.propose(plan_request()).text == "one"
    planner.close()
    assert [(one.finish, one.is_same) for one in read_shadow_log(log)] == [("error: no such thing", False)]
    assert "0 complete" in summarize_shadow(read_shadow_log(log))
    assert summarize_shadow(read_shadow_log(log)).endswith("; errors: 1")


def test_an_unwritable_log_is_rejected_and_a_later_failure_is_counted(tmp_path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(ConfigurationError, match="shadow log cannot be written"):
        ShadowedPlanner(ScriptedPlanner([]), ScriptedPlanner([]), tmp_path / "file" / "a.jsonl")
    log = tmp_path / "a.jsonl"
    planner = ShadowedPlanner(ScriptedPlanner(["one", "two"]), ScriptedPlanner(["one", "two"]), log)
    log.unlink()
    log.mkdir()
    planner.propose(plan_request())
    planner._thread.join()
    log.rmdir()
    planner.propose(plan_request())
    planner.close()
    assert [(one.candidate_text, one.passed_over) for one in read_shadow_log(log)] == [("two", 1)]


def test_a_log_of_an_older_version_is_read(tmp_path):
    log = tmp_path / "a.jsonl"
    log.write_text(
        '{"served":"a","candidate":"b","instruction":"w","served_text":"t","candidate_text":"t",'
        '"finish":"stop","seconds":1.5}\n'
    )
    assert [(one.is_same, one.passed_over) for one in read_shadow_log(log)] == [(True, 0)]
    assert summarize_shadow(read_shadow_log(log)).endswith("1 equal to the served answer, 1.5 s each (median)")


class Adapted(ScriptedPlanner):
    template, card = "0123456789abcdef", SimpleNamespace(id="a" * 64)

    def messages(self, request):
        return [{"role": "user", "content": request.instruction}]


def test_messages_and_provenance_are_those_of_the_serving_planner(tmp_path):
    log = tmp_path / "a.jsonl"
    adapted, bare = Adapted(["one"]), ScriptedPlanner(["one"])
    planner = ShadowedPlanner(adapted, bare, log)
    assert (
        planner_provenance(planner)
        == planner_provenance(adapted)
        == {"prompt": adapted.template, "adapter": adapted.card.id}
    )
    assert planner_messages(planner, plan_request("words")) == [{"role": "user", "content": "words"}]
    planner = ShadowedPlanner(bare, adapted, log)
    assert planner_provenance(planner) == planner_provenance(bare) == {"prompt": template_hash()}
    assert planner_template(planner) == template_hash()
    assert planner_messages(planner, plan_request()) == render(plan_request())


def test_an_incomplete_answer_never_counts_as_equal(tmp_path):
    log = tmp_path / "a.jsonl"
    planner = ShadowedPlanner(ScriptedPlanner([""]), ScriptedPlanner([""], finish_reason=protocol.TIMEOUT), log)
    planner.propose(plan_request())
    planner.close()
    assert not read_shadow_log(log)[0].is_same
    log.write_bytes(log.read_bytes() + b'{"served":"torn')
    assert len(read_shadow_log(log)) == 1
    assert summarize_shadow(read_shadow_log(tmp_path / "none.jsonl")) == "no shadow answers"


def test_a_line_that_a_crash_left_incomplete_is_replaced_by_the_next_record(tmp_path):
    log = tmp_path / "a.jsonl"
    for text, torn in (("one", b'{"served":"torn'), ("two", b"")):
        planner = ShadowedPlanner(ScriptedPlanner([text]), ScriptedPlanner([text]), log)
        planner.propose(plan_request())
        planner.close()
        log.write_bytes(log.read_bytes() + torn)
    assert [one.candidate_text for one in read_shadow_log(log)] == ["one", "two"]


def test_an_answer_that_json_cannot_contain_is_logged(tmp_path):
    log = tmp_path / "a.jsonl"
    planner = ShadowedPlanner(ScriptedPlanner(["a \ud800"]), ScriptedPlanner(["a \ud800"]), log)
    planner.propose(plan_request())
    planner.close()
    assert [(one.candidate_text, one.is_same) for one in read_shadow_log(log)] == [("a \ufffd", True)]


def test_a_damaged_log_is_reported(tmp_path):
    log = tmp_path / "a.jsonl"
    log.write_bytes(b"{}\n")
    with pytest.raises(ConfigurationError, match="shadow log is damaged"):
        read_shadow_log(log)


def test_a_shadow_name_has_a_candidate_and_a_serving_planner():
    assert parse_shadow_name("shadow:ab12") == ("adapter:ab12", "adapter:champion")
    assert parse_shadow_name("shadow:adapter:ab12@http://x/v1#m") == ("adapter:ab12", "http://x/v1#m")
