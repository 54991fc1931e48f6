"""Importer of robot descriptions: makes a robot folder with a `RobotModel` from a URDF or MJCF file."""
