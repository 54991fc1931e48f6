"""Fitting an adapter; everything in here needs torch (`pip install dualbrain[adapt]`), nothing else does."""
