"""Motion in the live view: the work of the filter, and the planned contract."""
