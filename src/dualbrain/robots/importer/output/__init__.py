"""Files that the importer writes: robot folder, page, comparison with an earlier import."""
