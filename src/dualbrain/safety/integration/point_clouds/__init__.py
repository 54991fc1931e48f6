"""Point clouds and depth images as obstacles: occupied voxels, covered by few boxes that are small near the robot."""
