"""What the body can do: one file a skill, its specification and its nominal controller φ."""
