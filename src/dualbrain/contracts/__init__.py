"""Typed action contracts (paper 3.3): skills with units and bounds, their JSON Schema, and the gate."""
