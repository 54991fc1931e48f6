"""A failed engine gives no answer, which is an error of the unit and not of the model."""

import pytest

from dualbrain.planner.backends.http_chat import ChatResponse
from dualbrain.planner.protocol import CRASHED, TIMEOUT
from dualbrain.planner.scripted import ScriptedPlanner
from experiments.adaptation import retention, starter
from experiments.adaptation.no_answer import NoAnswerError


@pytest.mark.parametrize("fault", [TIMEOUT, CRASHED])
def test_a_missing_answer_ends_the_unit(fault):
    with pytest.raises(NoAnswerError, match=fault):
        retention.answer_text(ChatResponse(text="", finish_reason=fault, detail="gone"))


@pytest.mark.parametrize("fault", [TIMEOUT, CRASHED])
def test_a_missing_answer_is_not_counted_in_a_comparison_of_planners(fault, monkeypatch):
    monkeypatch.setattr(starter, "cached_planner", lambda name: ScriptedPlanner(["{}"], finish_reason=fault))
    with pytest.raises(NoAnswerError, match=fault):
        starter.score_planner("starter-135m", starter.questions()[0])
