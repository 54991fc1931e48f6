"""Clients of the MCP server in Python and JavaScript, and the end of the server."""
