"""Commands: adapt, adapters."""
