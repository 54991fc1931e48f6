"""MuJoCo models of the robots, and the meshes and hulls in them."""
