"""Lateness of the control thread in C on an ordinary kernel, beside an empty thread and the tick in Python."""
