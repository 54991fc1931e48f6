"""Prompt texts and their assembly."""
