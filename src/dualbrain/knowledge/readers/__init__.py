"""Readers of Markdown, HTML and PDF documents; hidden text is removed."""
