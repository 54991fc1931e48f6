"""Evidence for a robot and site: hazards, requirements with tests and figures, limits, software, replay."""
