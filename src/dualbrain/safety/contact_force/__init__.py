"""Contact force: its estimate from measured torques or a wrench at the wrist, its limits, and permitted contact speeds."""
