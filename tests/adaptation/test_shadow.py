"""A candidate in the shadow is asked everything, heard by nobody, and written down."""

import pytest

from dualbrain.adaptation.serving.names import shadow_parts
from dualbrain.adaptation.serving.shadow import Shadowed, glances, summary
from dualbrain.errors import InvalidSetup
from dualbrain.planner import protocol
from dualbrain.planner.scripted import ScriptedPlanner
from tests.planner.questions import request


def test_who_serves_is_heard_and_the_shadow_is_written_down(tmp_path):
    log = tmp_path / "shadows" / "a.jsonl"
    serving, candidate = ScriptedPlanner(["one", "two"]), ScriptedPlanner(["one", "three"])
    planner = Shadowed(serving, candidate, log)
    assert [planner.propose(request(words)).text for words in ("first", "second")] == ["one", "two"]
    planner.close()
    assert [one.instruction for one in candidate.asked] == ["first", "second"]
    seen = glances(log)
    assert [(one.candidate_text, one.same) for one in seen] == [("one", True), ("three", False)]
    assert "asked 2 times in the shadow: 2 whole answers, 1 as who served" in summary(seen)


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
