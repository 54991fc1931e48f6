"""Tests of the episodic memory."""
