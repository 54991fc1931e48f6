"""Planners of the protocol: templates, random contracts, adversary, cached answers."""
