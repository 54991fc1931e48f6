"""Robot models (limits, kinematic chain, collision spheres) and the interface to read and command a robot."""
