"""Sphere and polytope approximations of link meshes, and the self-collision pairs to be checked."""
