"""Recording of every control tick (MCAP) and its bit-exact replay."""
