"""An agent of pydantic-ai moves a robot that it cannot misuse.

Run: `pip install "dualbrain[simulation]" "pydantic-ai-slim[openai]"`, set OPENAI_API_KEY, then
`python examples/agents/with_pydantic_ai.py "put the red cube in the bowl"`.
"""

from __future__ import annotations

import sys
from typing import Any

from pydantic_ai import Agent, Tool
from pydantic_ai.models import Model

from dualbrain import Robot

INSTRUCTIONS = "You move a robot. Look at the scene, then submit one contract. Correct it if it is rejected."


def make_agent(robot: Robot, model: Model | str) -> Agent:
    """An agent with the tools of `robot`."""

    def tool(definition: dict[str, Any]) -> Tool:
        def call(**arguments: Any) -> dict[str, Any]:
            return robot.call(definition["name"], arguments, client="pydantic-ai")

        schema = definition["input_schema"]
        return Tool.from_schema(call, definition["name"], definition["description"], schema)

    return Agent(model, instructions=INSTRUCTIONS, tools=[tool(one) for one in robot.tools("anthropic")])


if __name__ == "__main__":
    with Robot.simulated("panda", scene=8) as panda:
        print(make_agent(panda, "openai:gpt-5-mini").run_sync(" ".join(sys.argv[1:])).output)
