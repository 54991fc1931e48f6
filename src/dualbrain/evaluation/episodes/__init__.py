"""One evaluated episode: its run, scoring, timing, cache and repetition."""
