"""Skills of a robot, one file each: its specification and its nominal controller φ (paper 4.2)."""
