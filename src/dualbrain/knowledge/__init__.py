"""Document index (paper 5): rules, manuals, maps and task templates, retrieved with exact citations."""
