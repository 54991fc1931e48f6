"""Commands: run, demo, plan, check, schema, replay, fault."""
