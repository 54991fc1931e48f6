"""dualbrain mcp and dualbrain console: a robot for agents, over stdio and HTTP."""
