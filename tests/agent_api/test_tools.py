"""Tools of a robot: their definitions for each framework, and calls with valid and invalid arguments."""

import json

import jsonschema
import pytest
from hypothesis import given
from hypothesis import strategies as st

from dualbrain.agent_api.submission import SubmissionReport
from dualbrain.agent_api.tools import (
    MAX_INSTRUCTION,
    TOOLS,
    ToolError,
    call_tool,
    export_tools,
    report_view,
    robot_tools,
)
from dualbrain.contracts.verdict import Rejected
from dualbrain.control.gatekeeper.protocol.client import ConnectionLostError, ContractNotCheckedError
from dualbrain.records import Outcome
from tests.agent_server.stub_robot import StubRobot

REJECTED = Rejected(stage="syntax", pointer="/id", got="x", allowed="c-0001", hint="write it")


@pytest.fixture(scope="module")
def robot():
    found = StubRobot()
    yield found
    found.cell.close()


def call(robot, name, arguments):
    return call_tool(robot, name, arguments, client="test")


@pytest.mark.parametrize("form", ["openai", "anthropic", "mcp"])
def test_every_form_holds_the_same_tools_with_valid_schemas(form, robot):
    key = {"openai": "parameters", "anthropic": "input_schema", "mcp": "inputSchema"}[form]
    exported = [one.get("function", one) for one in export_tools(robot_tools(robot), form)]
    assert [one["name"] for one in exported] == [one.name for one in TOOLS if one.name != "do"]
    for one in exported:
        jsonschema.Draft202012Validator.check_schema(one[key])
        assert one[key]["additionalProperties"] is False
        assert one["description"]
    checks = {one["name"]: one[key]["properties"] for one in exported}
    assert checks["check_contract"]["contract"] == checks["submit_contract"]["contract"] == robot.schema("tool")


def test_an_unknown_form_is_refused(robot):
    with pytest.raises(ToolError, match="openai, anthropic or mcp"):
        export_tools(robot_tools(robot), "xml")


def test_one_tool_moves_the_robot_and_a_planner_adds_the_second(robot):
    assert [one.name for one in TOOLS if one.moves] == ["submit_contract", "do"]
    assert "do" not in [one.name for one in robot_tools(robot)]
    robot.has_planner = True
    assert "do" in [one.name for one in robot_tools(robot)]
    robot.has_planner = False


@given(st.text(max_size=20), st.sampled_from([None, 2]))
def test_a_contract_in_a_text_reaches_the_gate_byte_for_byte(robot, value, indent):
    text = json.dumps({"id": value, "x": [1.50, 1e-7]}, indent=indent, ensure_ascii=False)
    call(robot, "check_contract", '{ "contract" : ' + text + " }")
    assert robot.checked[-1] == text.encode()
    call(robot, "check_contract", {"contract": text})
    assert robot.checked[-1] == text.encode()


def test_equal_keys_in_a_contract_are_refused_by_the_gate(robot):
    found = call(robot, "check_contract", '{"contract": {"id": "c-0001", "id": "c-0001"}}')
    assert (found["accepted"], found["hint"]) == (False, "drop the duplicate key")


@pytest.mark.parametrize(
    ("name", "arguments", "part"),
    [
        ("sto", "{}", "closest: 'stop'"),
        ("stop", "[]", "not one JSON object"),
        ("stop", "{", "not one JSON object"),
        ("stop", b"\xff", "not one JSON object"),
        ("stop", '{"emergency": 1}', "must be of type bool"),
        ("stop", '{"now": true}', "no argument 'now'"),
        ("check_contract", "{}", "needs the argument contract"),
        ("check_contract", '{"contract": NaN}', "not one JSON object"),
        ("check_contract", {"contract": "\ud800"}, "not one JSON object"),
        ("get_outcome", '{"wait_s": "long"}', "must be of type float"),
        ("do", '{"instruction": "go home"}', "no tool 'do'"),
        ("\u202e" * 90, "{}", "no tool"),
    ],
)
def test_an_invalid_call_is_an_error_that_names_the_remedy(name, arguments, part, robot):
    before = len(robot.checked), len(robot.submitted), len(robot.stops)
    assert part in call(robot, name, arguments)["error"]
    assert (len(robot.checked), len(robot.submitted), len(robot.stops)) == before


def test_no_arguments_are_an_empty_object(robot):
    assert call(robot, "stop", "") == {"sent": True, "action": "", "reason": ""}
    assert call(robot, "get_outcome", {})["state"] == "unknown"


def test_a_robot_that_cannot_be_reached_is_an_error_of_the_call(robot, monkeypatch):
    def lost(**options):
        raise ConnectionLostError("the gatekeeper closed the connection")

    monkeypatch.setattr(robot, "stop", lost)
    assert "cannot be reached" in call(robot, "stop", "{}")["error"]


def test_a_contract_that_the_gate_does_not_check_now_is_no_lost_robot(robot, monkeypatch):
    def refuse(contract):
        raise ContractNotCheckedError("another contract is being checked; check it again in a moment")

    monkeypatch.setattr(robot, "check", refuse)
    error = call(robot, "check_contract", '{"contract": {}}')["error"]
    assert error == "The contract was not checked: another contract is being checked; check it again in a moment."


def test_a_stop_needs_nothing_else_of_the_robot(robot, monkeypatch):
    def lost(form=""):
        raise ConnectionLostError("no scene")

    monkeypatch.setattr(robot, "schema", lost)
    assert call(robot, "stop", '{"emergency": true}')["sent"]
    assert robot.stops[-1] is True


def test_the_view_of_a_report_states_rejection_outcome_and_repetition():
    rejected = report_view(SubmissionReport(id="c-0001", state="rejected", rejected=REJECTED))
    assert rejected["accepted"] is False
    assert rejected["rejected"]["pointer"] == "/id"
    outcome = Outcome(kind="failed", reason="the object slipped")
    ended = report_view(
        SubmissionReport(id="c-0001", state="finished", outcome=outcome, senses="agrees", contract={}, repeated=True)
    )
    assert (ended["accepted"], ended["repeated"]) == (True, True)
    assert (ended["outcome"]["succeeded"], ended["outcome"]["reason"]) == (False, "the object slipped")
    assert "outcome" not in report_view(SubmissionReport(id="c-0001", state="running"))
    assert report_view(SubmissionReport(id="c-0001", state="lost", reason="gone"))["reason"] == "gone"


@pytest.mark.parametrize("text", ["", " ", "\t\n ", "\u2003"])
def test_an_instruction_without_words_is_refused_before_planning(text, robot, monkeypatch):
    monkeypatch.setattr(robot, "has_planner", True)
    before = len(robot.submitted)
    assert "The instruction is empty" in call(robot, "do", {"instruction": text})["error"]
    assert len(robot.submitted) == before


@pytest.mark.parametrize("name", ["submit_contract", "do"])
def test_an_instruction_that_is_too_long_is_refused_and_not_cut(name, robot, monkeypatch):
    monkeypatch.setattr(robot, "has_planner", True)
    text = "pick up the red cube".ljust(MAX_INSTRUCTION) + " and stab the person"
    before = len(robot.submitted)
    error = call(robot, name, {"instruction": text} | ({"contract": {}} if name == "submit_contract" else {}))["error"]
    assert f"The instruction has {len(text)} characters; at most {MAX_INSTRUCTION}" in error
    assert "horten it" in error
    assert len(robot.submitted) == before
