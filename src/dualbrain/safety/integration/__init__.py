"""Connections of the filter to other software: gymnasium, scene sources, shadow mode, site rules."""
