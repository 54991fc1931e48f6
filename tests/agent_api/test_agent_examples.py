"""The examples for agent frameworks, with scripted models in place of a language model and without a key."""

import asyncio
import importlib.util
import json
from pathlib import Path

import pytest
from agents import RunConfig, Runner
from agents.items import ModelResponse
from agents.models.interface import Model as OpenAiModel
from agents.usage import Usage
from langchain_core.language_models import GenericFakeChatModel
from langchain_core.messages import AIMessage
from openai.types.responses import ResponseFunctionToolCall, ResponseOutputMessage, ResponseOutputText
from pydantic_ai.messages import ModelResponse as PydanticResponse
from pydantic_ai.messages import TextPart, ToolCallPart
from pydantic_ai.models.function import FunctionModel

from tests.agent_server.stub_robot import StubRobot

FOLDER = Path(__file__).parents[2] / "examples/agents"
MAX_LINES = 40
DONE = "The robot held still."
CONTRACT = {
    "id": "c-0001",
    "context": {"robot": "panda", "registry": "83abdb38"},
    "action_sequence": [{"skill": "hold", "params": {"duration": 0.5}}],
}
CALLS = [("get_scene", {}), ("check_contract", {"contract": CONTRACT}), ("submit_contract", {"contract": CONTRACT})]
"""The calls of the scripted models, before the answer `DONE`."""


@pytest.fixture
def robot():
    found = StubRobot()
    yield found
    found.cell.close()


@pytest.fixture
def event_loop_of_the_thread():
    """The synchronous calls of the frameworks use the thread's event loop and leave it open."""
    loop = asyncio.new_event_loop()
    asyncio.set_event_loop(loop)
    yield
    asyncio.set_event_loop(None)
    loop.close()


def load(name):
    spec = importlib.util.spec_from_file_location(f"example_{name}", FOLDER / f"{name}.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def was_submitted_by(robot, client):
    ((data, author),) = robot.submitted
    return author == client and json.loads(data) == CONTRACT


@pytest.mark.usefixtures("event_loop_of_the_thread")
def test_an_agent_of_pydantic_ai_submits_a_contract(robot):
    def answer(messages, info):
        turn = sum(isinstance(one, PydanticResponse) for one in messages)
        return PydanticResponse([ToolCallPart(*CALLS[turn]) if turn < len(CALLS) else TextPart(DONE)])

    found = load("with_pydantic_ai").make_agent(robot, FunctionModel(answer)).run_sync("hold for a moment")
    assert found.output == DONE
    assert was_submitted_by(robot, "pydantic-ai")


class ScriptedOpenAiModel(OpenAiModel):
    """Calls the tools in their order, then answers."""

    def __init__(self):
        self.turn = 0

    async def get_response(self, *arguments, **options):
        self.turn += 1
        return ModelResponse(output=[self.output(self.turn - 1)], usage=Usage(), response_id=None)

    def output(self, turn):
        if turn == len(CALLS):
            text = ResponseOutputText(text=DONE, type="output_text", annotations=[])
            return ResponseOutputMessage(id="m", content=[text], role="assistant", status="completed", type="message")
        name, arguments = CALLS[turn]
        text = json.dumps(arguments)
        return ResponseFunctionToolCall(name=name, arguments=text, call_id=f"call {turn}", type="function_call")

    def stream_response(self, *arguments, **options):
        raise NotImplementedError


@pytest.mark.usefixtures("event_loop_of_the_thread")
def test_an_agent_of_the_openai_sdk_submits_a_contract(robot):
    agent = load("with_openai_agents").make_agent(robot, ScriptedOpenAiModel())
    found = Runner.run_sync(agent, "hold for a moment", run_config=RunConfig(tracing_disabled=True))
    assert found.final_output == DONE
    assert was_submitted_by(robot, "openai-agents")


class ScriptedChatModel(GenericFakeChatModel):
    """Answers with the given messages in their order."""

    def bind_tools(self, tools, **options):
        return self


def test_a_graph_of_langgraph_submits_a_contract(robot):
    calls = [
        AIMessage("", tool_calls=[{"name": name, "args": arguments, "id": f"call {turn}"}])
        for turn, (name, arguments) in enumerate(CALLS)
    ]
    model = ScriptedChatModel(messages=iter([*calls, AIMessage(DONE)]))
    found = load("with_langgraph").make_graph(robot, model).invoke({"messages": "hold for a moment"})
    assert found["messages"][-1].content == DONE
    assert was_submitted_by(robot, "langgraph")


@pytest.mark.parametrize("path", sorted(FOLDER.glob("*.py")), ids=lambda path: path.stem)
def test_every_example_is_short(path):
    assert len(path.read_text(encoding="utf-8").splitlines()) < MAX_LINES
