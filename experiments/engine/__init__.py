"""Engine of the experiments: units, catalogue, pages."""
