"""Tables and plots of the experiments."""
