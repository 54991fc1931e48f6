"""Collection of training episodes: rollouts, starter data set, synthetic scenes."""
