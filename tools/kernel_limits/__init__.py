"""Resource limits of the compiled kernel: stack, memory, code size, QP iterations, time."""
