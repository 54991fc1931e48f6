"""The SO-101 with stock position servos in MuJoCo: identification of its tracking error, and a careless policy."""
