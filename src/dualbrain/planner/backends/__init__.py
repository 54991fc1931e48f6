"""Backends of language models: llama.cpp in a worker process, OpenAI-compatible servers, Ollama."""
