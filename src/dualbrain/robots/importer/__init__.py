"""Importer of URDF and MJCF descriptions: from a description file to a `RobotModel` folder."""
