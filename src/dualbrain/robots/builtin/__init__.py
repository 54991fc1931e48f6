"""Generators of the packaged robots: Panda, FR3, UR5e, a mobile base and a mobile Panda."""
