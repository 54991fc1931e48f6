"""Other people's safety filters beside ours: every contestant in a process of its own, on the same states."""
