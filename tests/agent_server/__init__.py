"""Tests of the servers for agents."""
