"""Static analysis and fuzzing of the C kernel."""
