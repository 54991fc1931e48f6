"""The safety layer on a microcontroller: robot tables, firmware, link, and the filter on the target."""
