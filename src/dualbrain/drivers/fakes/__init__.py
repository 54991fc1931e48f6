"""Fakes of the vendors' libraries, for tests without hardware."""
