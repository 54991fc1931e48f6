"""Tests of the agent interface."""
