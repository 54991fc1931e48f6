"""Contact force: its estimate from the torques of the motors or a wrench at the wrist, its limits, and the retreat."""
