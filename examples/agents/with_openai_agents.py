"""An agent of the OpenAI Agents SDK moves a robot that it cannot misuse.

Run: `pip install "dualbrain[simulation]" openai-agents`, set OPENAI_API_KEY, then
`python examples/agents/with_openai_agents.py "put the red cube in the bowl"`.
"""

from __future__ import annotations

import json
import sys
from typing import Any

from agents import Agent, FunctionTool, Model, Runner

from dualbrain import Robot

INSTRUCTIONS = "You move a robot. Look at the scene, then submit one contract. Correct it if it is rejected."


def make_agent(robot: Robot, model: Model | str | None = None) -> Agent:
    """An agent with the tools of `robot`; the JSON text of the model reaches the robot's gate unchanged."""

    def tool(definition: dict[str, Any]) -> FunctionTool:
        async def call(context: Any, arguments: str) -> str:
            return json.dumps(robot.call(definition["name"], arguments, client="openai-agents"))

        name, description = definition["name"], definition["description"]
        return FunctionTool(name, description, definition["parameters"], call, strict_json_schema=False)

    tools = [tool(one["function"]) for one in robot.tools("openai")]
    return Agent("planner", instructions=INSTRUCTIONS, model=model, tools=tools)


if __name__ == "__main__":
    with Robot.simulated("panda", scene=8) as panda:
        print(Runner.run_sync(make_agent(panda), " ".join(sys.argv[1:])).final_output)
