"""Experiments with the safety layer as firmware on emulated boards."""
