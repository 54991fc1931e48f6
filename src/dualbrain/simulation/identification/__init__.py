"""Identification of the tracking model of a simulated drive."""
