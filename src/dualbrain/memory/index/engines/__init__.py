"""Vector engines: programs that store vectors outside of this process and find those nearest to a query."""
