"""The loop: words to motion to memory, recorded and replayable."""
