"""The prompt of a planner, and the names of retrieved fields that the prompt cannot show."""

import pytest

from dualbrain.planner.introspection import no_documents_reason, planner_messages, planner_template, unsupported_fields
from dualbrain.planner.prompt.full_prompt import render, template_hash
from dualbrain.planner.prompt.prompt_format import short_messages
from dualbrain.planner.prompt.short_prompt import short_template_hash
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.records import Passage, RetrievedContext
from tests.planner.sample_requests import exemplar, plan_request

PASSAGE = Passage(
    citation="site-rules@1",
    kind="rule",
    trust="site",
    title="Rules",
    text="walk slowly",
    likeness=0.5,
    score=0.5,
    rank=1,
)
RETRIEVED = {"warnings": (exemplar(succeeded=False),), "passages": (PASSAGE,)}


class ShortPromptPlanner(ScriptedPlanner):
    template, messages = short_template_hash(), staticmethod(short_messages)


def test_a_planner_without_own_messages_has_the_full_prompt():
    planner = ScriptedPlanner([])
    assert planner_messages(planner, plan_request()) == render(plan_request())
    assert planner_template(planner) == template_hash()
    assert no_documents_reason(planner) == ""


def test_a_planner_with_own_messages_has_these():
    assert planner_messages(ShortPromptPlanner([]), plan_request()) == short_messages(plan_request())
    assert planner_template(ShortPromptPlanner([])) == short_template_hash()
    assert "not shown to scripted" in no_documents_reason(ShortPromptPlanner([]))


@pytest.mark.parametrize("name", RETRIEVED)
def test_unsupported_fields_are_those_that_do_not_change_the_prompt(name):
    recall = RetrievedContext(**{name: RETRIEVED[name]})
    for planner in (ScriptedPlanner([]), ShortPromptPlanner([])):
        shown = planner_messages(planner, plan_request(recall=recall)) != planner_messages(planner, plan_request())
        assert unsupported_fields(planner_template(planner), recall) == (() if shown else (name,))
    assert unsupported_fields(short_template_hash(), RetrievedContext()) == ()
