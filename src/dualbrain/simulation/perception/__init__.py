"""Perception models: bounded noise, depth cameras, fitted primitives, rendering."""
