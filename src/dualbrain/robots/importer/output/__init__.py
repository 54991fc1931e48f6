"""Output of the importer: robot folder, README page, comparison with an earlier import."""
