"""Tests of `dualbrain.safety.integration.point_clouds`."""
