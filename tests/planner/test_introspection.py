"""What a planner reads is told by itself; what has no place in its prompt is named."""

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
FOUND = {"warnings": (exemplar(succeeded=False),), "passages": (PASSAGE,)}


class Short(ScriptedPlanner):
    template, messages = short_template_hash(), staticmethod(short_messages)


def test_a_planner_that_tells_nothing_reads_the_full_prompt():
    planner = ScriptedPlanner([])
    assert planner_messages(planner, plan_request()) == render(plan_request())
    assert planner_template(planner) == template_hash()
    assert no_documents_reason(planner) == ""


def test_one_that_tells_what_it_reads_is_believed():
    assert planner_messages(Short([]), plan_request()) == short_messages(plan_request())
    assert planner_template(Short([])) == short_template_hash()
    assert "not shown to scripted" in no_documents_reason(Short([]))


@pytest.mark.parametrize("name", FOUND)
def test_what_is_named_as_unread_is_what_leaves_the_prompt_as_it_was(name):
    recall = RetrievedContext(**{name: FOUND[name]})
    for planner in (ScriptedPlanner([]), Short([])):
        shown = planner_messages(planner, plan_request(recall=recall)) != planner_messages(planner, plan_request())
        assert unsupported_fields(planner_template(planner), recall) == (() if shown else (name,))
    assert unsupported_fields(short_template_hash(), RetrievedContext()) == ()
