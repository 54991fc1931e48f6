"""Planners that report a growing answer, and those that do not."""

import pytest

from dualbrain.adaptation.serving.adapted_planner import AdaptedPlanner
from dualbrain.adaptation.serving.shadow import ShadowedPlanner
from dualbrain.planner.backends.llama_cpp import LlamaPlanner
from dualbrain.planner.protocol import StreamingPlanner, show_answers
from dualbrain.planner.scripted import ScriptedPlanner


@pytest.mark.parametrize("kind", [LlamaPlanner, AdaptedPlanner, ShadowedPlanner])
def test_planners_in_llama_cpp_report_their_answer_while_it_grows(kind: type) -> None:
    assert issubclass(kind, StreamingPlanner)


def test_a_wrapper_forwards_to_the_planner_that_answers() -> None:
    shown: list[str] = []

    class Answering:
        def show_answers(self, show):
            show("a beginning")

    adapted = AdaptedPlanner.__new__(AdaptedPlanner)
    adapted._inner = Answering()
    show_answers(adapted, shown.append)
    assert shown == ["a beginning"]


def test_another_planner_shows_nothing() -> None:
    show_answers(ScriptedPlanner([]), pytest.fail)
