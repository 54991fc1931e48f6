"""Mesh files and XML of robot descriptions, read safely."""
