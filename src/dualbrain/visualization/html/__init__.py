"""HTML report of one run, without scripts or external assets."""
