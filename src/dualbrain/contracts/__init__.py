"""Action contracts: skills with units and bounds, the JSON Schema they generate, and the contract (paper 3.3)."""
