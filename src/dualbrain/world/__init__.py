"""Where it happens: the physics plant, scenes, perception and the independent monitor."""
