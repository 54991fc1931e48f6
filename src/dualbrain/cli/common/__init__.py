"""Shared parts of the commands: console, exit codes, paths, signals."""
