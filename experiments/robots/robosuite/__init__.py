"""The safety filter in the loop of robosuite, a foreign task suite, in its own environment and process."""
