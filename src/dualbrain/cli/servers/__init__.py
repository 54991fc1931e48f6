"""Commands that serve a robot until they are ended: gatekeeper, mcp, console."""
