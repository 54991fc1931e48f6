"""What may be said: skills with units and bounds, the schema they generate, and the gate that checks every contract."""
