"""From a robot's description (URDF, MJCF) to a `Body`: tree, chain, cover, limits, folder."""
