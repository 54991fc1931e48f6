"""Fakes of vendor libraries, for tests without hardware."""
