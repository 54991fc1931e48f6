"""A graph of LangGraph moves a robot that it cannot misuse.

Run: `pip install "dualbrain[simulation]" langgraph langchain-openai`, set OPENAI_API_KEY, then
`python examples/agents/with_langgraph.py "put the red cube in the bowl"`.
"""

from __future__ import annotations

import sys
from typing import Any

from langchain_core.tools import StructuredTool
from langgraph.graph import START, MessagesState, StateGraph
from langgraph.prebuilt import ToolNode, tools_condition

from dualbrain import Robot


def make_graph(robot: Robot, model: Any) -> Any:
    """A graph in which `model` calls the tools of `robot` until it answers."""

    def tool(name: str, description: str, schema: dict[str, Any]) -> StructuredTool:
        def call(**arguments: Any) -> dict[str, Any]:
            return robot.call(name, arguments, client="langgraph")

        return StructuredTool(name=name, description=description, args_schema=schema, func=call)

    tools = [tool(one["name"], one["description"], one["input_schema"]) for one in robot.tools("anthropic")]
    bound, graph = model.bind_tools(tools), StateGraph(MessagesState).add_node("tools", ToolNode(tools))
    graph.add_node("model", lambda state: {"messages": [bound.invoke(state["messages"])]})
    graph.add_edge(START, "model").add_conditional_edges("model", tools_condition).add_edge("tools", "model")
    return graph.compile()


if __name__ == "__main__":
    from langchain_openai import ChatOpenAI

    with Robot.simulated("panda", scene=8) as panda:
        print(make_graph(panda, ChatOpenAI()).invoke({"messages": " ".join(sys.argv[1:])})["messages"][-1].content)
