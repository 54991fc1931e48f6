"""Backends of a session: the simulator of this process, or a gatekeeper process in real time."""
