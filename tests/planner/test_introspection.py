"""What a planner reads is told by itself; what has no place in its prompt is named."""

import pytest

from dualbrain.planner.introspection import deaf_to_documents, messages_of, template_of, unread
from dualbrain.planner.prompt.full_prompt import render, template_hash
from dualbrain.planner.prompt.prompt_format import short_messages
from dualbrain.planner.prompt.short_prompt import short_template_hash
from dualbrain.planner.scripted import ScriptedPlanner
from dualbrain.records import Passage, Recall
from tests.planner.sample_requests import exemplar, request

PASSAGE = Passage("site-rules@1", "rule", "site", "Rules", "walk slowly", 0.5, 0.5, 1)
FOUND = {"warnings": (exemplar(succeeded=False),), "passages": (PASSAGE,)}


class Short(ScriptedPlanner):
    template, messages = short_template_hash(), staticmethod(short_messages)


def test_a_planner_that_tells_nothing_reads_the_full_prompt():
    planner = ScriptedPlanner([])
    assert messages_of(planner, request()) == render(request())
    assert template_of(planner) == template_hash()
    assert deaf_to_documents(planner) == ""


def test_one_that_tells_what_it_reads_is_believed():
    assert messages_of(Short([]), request()) == short_messages(request())
    assert template_of(Short([])) == short_template_hash()
    assert "not shown to scripted" in deaf_to_documents(Short([]))


@pytest.mark.parametrize("name", FOUND)
def test_what_is_named_as_unread_is_what_leaves_the_prompt_as_it_was(name):
    recall = Recall(**{name: FOUND[name]})
    for planner in (ScriptedPlanner([]), Short([])):
        shown = messages_of(planner, request(recall=recall)) != messages_of(planner, request())
        assert unread(template_of(planner), recall) == (() if shown else (name,))
    assert unread(short_template_hash(), Recall()) == ()
