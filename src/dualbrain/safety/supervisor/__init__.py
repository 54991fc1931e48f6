"""The supervisor: hazard checks, safety actions from warning to emergency stop, and their enforcement."""
