"""Definitions of the packaged robots (Panda, FR3, UR5e, mobile base, mobile Panda) and the generator of their data."""
