"""Tests of the commands for agents."""
