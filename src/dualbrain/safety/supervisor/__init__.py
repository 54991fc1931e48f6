"""Supervisor: monitors the robot, its sensors and the filter, and overrides the nominal control when a check trips."""
