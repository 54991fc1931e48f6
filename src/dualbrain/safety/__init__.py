"""The safety layer: barriers, the CBF-QP filter, the supervisor above it, and integrations for other software."""
