"""Rules of the envelope stage that depend on scene and robot, and the same bounds for constrained decoders."""
