"""Instructions of one step on a microcontroller, counted by an emulator."""
