"""Limits of the speed and the jerk against an adversary: classes of loops, an independent judge, and tables."""
