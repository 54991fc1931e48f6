"""Prompt texts, and rendering of requests to prompts."""
