"""Forward invariance of the filter against an adversary: classes of errors, loops, and tables."""
