"""Learning from outcomes: weight updates, trust in sources, consolidation."""
