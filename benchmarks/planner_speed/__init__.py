"""Time of a plan: before and after a change of decoding or prompt, and in different engines."""
