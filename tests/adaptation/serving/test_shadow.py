"""A candidate in the shadow is asked everything, heard by nobody, and written down."""

import time
from threading import Event
from types import SimpleNamespace

import pytest

from dualbrain.adaptation.adapters.naming import shadow_parts
from dualbrain.adaptation.serving import shadow
from dualbrain.adaptation.serving.open_planner import origin
from dualbrain.adaptation.serving.shadow import Shadowed, glances, summary
from dualbrain.errors import InvalidSetup
from dualbrain.planner import protocol
from dualbrain.planner.introspection import messages_of, template_of
from dualbrain.planner.prompt.full_prompt import render, template_hash
from dualbrain.planner.scripted import ScriptedPlanner
from tests.planner.sample_requests import request


def test_who_serves_is_heard_and_the_shadow_is_written_down(tmp_path):
    log = tmp_path / "shadows" / "a.jsonl"
    serving, candidate = ScriptedPlanner(["one", "two"]), ScriptedPlanner(["one", "three"])
    planner = Shadowed(serving, candidate, log)
    for words, text in (("first", "one"), ("second", "two")):
        assert planner.propose(request(words)).text == text
        planner._asking.join()
    planner.close()
    assert [one.instruction for one in candidate.asked] == ["first", "second"]
    seen = glances(log)
    assert [(one.candidate_text, one.same) for one in seen] == [("one", True), ("three", False)]
    assert "asked 2 times in the shadow: 2 whole answers, 1 as who served" in summary(seen)


class Slow(ScriptedPlanner):
    """Answers when it is let, or when it is closed."""

    def __init__(self, texts):
        super().__init__(texts)
        self.let = Event()

    def propose(self, request):
        self.let.wait(60.0)
        return super().propose(request)

    def close(self):
        self.let.set()


class Raises(ScriptedPlanner):
    def propose(self, request):
        raise OSError("no such thing")


def test_nobody_waits_for_the_shadow_and_what_it_has_no_time_for_is_counted(tmp_path):
    log = tmp_path / "a.jsonl"
    candidate = Slow(["one", "four"])
    planner = Shadowed(ScriptedPlanner(["one", "two", "three", "four", "five"]), candidate, log)
    for words in ("first", "second", "third"):
        planner.propose(request(words))  # a wait would outlast the test
    assert glances(log) == ()
    candidate.let.set()
    planner._asking.join()
    assert [(one.instruction, one.passed_over) for one in glances(log)] == [("first", 2)]
    planner.propose(request("fourth"))
    planner.close()
    assert [(one.instruction, one.same, one.passed_over) for one in glances(log)][1:] == [("fourth", True, 0)]
    assert "; 2 more passed over" in summary(glances(log))


def test_at_the_end_an_answer_under_way_has_a_short_while_and_is_then_cut_off(tmp_path, monkeypatch):
    monkeypatch.setattr(shadow, "PATIENCE_S", 0.05)
    planner = Shadowed(ScriptedPlanner(["one"]), Slow(["one"]), tmp_path / "a.jsonl")
    planner.propose(request())
    begun = time.monotonic()
    planner.close()
    planner._asking.join()
    assert time.monotonic() - begun < 30.0
    assert len(glances(tmp_path / "a.jsonl")) == 1


def test_an_error_of_the_candidate_is_written_down_and_told(tmp_path):
    log = tmp_path / "a.jsonl"
    planner = Shadowed(ScriptedPlanner(["one"]), Raises([]), log)
    assert planner.propose(request()).text == "one"
    planner.close()
    assert [(one.finish, one.same) for one in glances(log)] == [("error: no such thing", False)]
    assert "0 whole answers" in summary(glances(log))
    assert summary(glances(log)).endswith("; errors: 1")


def test_a_log_that_cannot_be_written_is_refused_and_one_that_fails_later_is_counted(tmp_path):
    (tmp_path / "file").write_text("no folder")
    with pytest.raises(InvalidSetup, match="log of the shadow"):
        Shadowed(ScriptedPlanner([]), ScriptedPlanner([]), tmp_path / "file" / "a.jsonl")
    log = tmp_path / "a.jsonl"
    planner = Shadowed(ScriptedPlanner(["one", "two"]), ScriptedPlanner(["one", "two"]), log)
    log.unlink()
    log.mkdir()
    planner.propose(request())
    planner._asking.join()
    log.rmdir()
    planner.propose(request())
    planner.close()
    assert [(one.candidate_text, one.passed_over) for one in glances(log)] == [("two", 1)]


def test_a_log_of_an_older_version_is_read(tmp_path):
    log = tmp_path / "a.jsonl"
    log.write_text('{"served":"a","candidate":"b","instruction":"w","served_text":"t","candidate_text":"t",'
                   '"finish":"stop","seconds":1.5}\n')  # fmt: skip
    assert [(one.same, one.passed_over) for one in glances(log)] == [(True, 0)]
    assert summary(glances(log)).endswith("1 as who served, 1.5 s each (median)")


class Adapted(ScriptedPlanner):
    template, card = "0123456789abcdef", SimpleNamespace(id="a" * 64)

    def messages(self, request):
        return [{"role": "user", "content": request.instruction}]


def test_what_is_read_and_recorded_is_that_of_who_serves(tmp_path):
    log = tmp_path / "a.jsonl"
    adapted, bare = Adapted(["one"]), ScriptedPlanner(["one"])
    planner = Shadowed(adapted, bare, log)
    assert origin(planner) == origin(adapted) == {"prompt": adapted.template, "adapter": adapted.card.id}
    assert messages_of(planner, request("words")) == [{"role": "user", "content": "words"}]
    planner = Shadowed(bare, adapted, log)
    assert origin(planner) == origin(bare) == {}
    assert template_of(planner) == template_hash()
    assert messages_of(planner, request()) == render(request())


def test_an_answer_that_is_not_whole_is_never_the_same(tmp_path):
    log = tmp_path / "a.jsonl"
    planner = Shadowed(ScriptedPlanner([""]), ScriptedPlanner([""], finish_reason=protocol.TIMEOUT), log)
    planner.propose(request())
    planner.close()
    assert not glances(log)[0].same
    log.write_bytes(log.read_bytes() + b'{"served":"torn')
    assert len(glances(log)) == 1
    assert summary(glances(tmp_path / "none.jsonl")) == "never asked in the shadow"


def test_a_damaged_log_is_told(tmp_path):
    log = tmp_path / "a.jsonl"
    log.write_bytes(b"{}\n")
    with pytest.raises(InvalidSetup, match="log of the shadow"):
        glances(log)


def test_a_name_says_who_stands_in_whose_shadow():
    assert shadow_parts("shadow:ab12") == ("adapter:ab12", "adapter:champion")
    assert shadow_parts("shadow:adapter:ab12@http://x/v1#m") == ("adapter:ab12", "http://x/v1#m")
