"""What is written: rules, manuals, maps and task templates, quoted exactly, found by words and by meaning (paper 5)."""
