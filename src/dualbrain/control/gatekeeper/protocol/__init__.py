"""Protocol between a commander and the gatekeeper: frames, messages, authentication, server, client."""
