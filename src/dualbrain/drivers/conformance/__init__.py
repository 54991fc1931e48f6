"""Conformance test of drivers: the requirements on every driver, and the test harness."""
