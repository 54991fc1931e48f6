"""dualbrain: a language model proposes, a local safety filter disposes."""

__version__ = "0.1.0"
