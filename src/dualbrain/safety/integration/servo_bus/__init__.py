"""A bus of position servos behind the guard: named joints in degrees, one writer, the newest safe target."""
