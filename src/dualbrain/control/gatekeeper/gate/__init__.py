"""The gatekeeper's gate, in a process of its own: no contract delays a control tick."""
