"""Joint embedding of text, scene symbols, robot state and image features."""
