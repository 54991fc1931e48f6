"""`guard_fetch` and `guard_metaworld` in the environments of their suites, each in a virtual environment of its own."""
