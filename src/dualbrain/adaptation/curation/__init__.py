"""Curation of the data set D_clean from recorded episodes."""
