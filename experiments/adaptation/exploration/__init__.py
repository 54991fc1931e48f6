"""Fits and answers of planners that were adapted by exploration."""
