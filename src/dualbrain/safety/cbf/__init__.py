"""Velocity-level CBF-QP filter. Only `kernel`, `batch` and `qp` call the compiled C code."""
