"""Senses that judge the outcome of an episode independently of the skills that executed it."""
