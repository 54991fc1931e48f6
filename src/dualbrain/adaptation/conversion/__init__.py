"""Conversion of adapters and base models between formats (peft, GGUF)."""
