"""What the compiled kernel needs at worst: stack, memory, code, iterations, time."""
