"""Sphere and polytope approximations of link meshes, and the choice of self-collision pairs."""
