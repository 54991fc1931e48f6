"""Readers of Markdown, HTML and PDF documents, which remove hidden text."""
