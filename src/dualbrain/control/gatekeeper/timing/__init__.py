"""Timing of the control tick: periods, durations, histograms."""
