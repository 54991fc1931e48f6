"""The bounded Hebbian rule (paper 5.3) and the quantities it uses."""
