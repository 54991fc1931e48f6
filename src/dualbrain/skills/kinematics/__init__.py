"""Inverse kinematics, resolved-rate control, clearance prediction and object geometry."""
