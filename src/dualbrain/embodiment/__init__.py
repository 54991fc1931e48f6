"""What the body is: limits, chain, spheres, and the protocol by which it is read and moved."""
