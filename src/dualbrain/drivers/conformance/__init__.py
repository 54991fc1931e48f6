"""Requirements on every driver, and the harness that tests them."""
