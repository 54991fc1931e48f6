"""The bounded Hebbian weight update (paper 5.3), and the comparisons and maps that it uses."""
