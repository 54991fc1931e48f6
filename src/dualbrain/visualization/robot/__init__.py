"""Images and interactive view of a robot model."""
