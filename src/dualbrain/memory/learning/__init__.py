"""Weight updates from outcomes, trust in sources, consolidation."""
