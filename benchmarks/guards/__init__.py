"""Benchmark of guards: policies of different care behind each of several safety filters, in the same scenes."""
