"""Language-model backends: llama.cpp in a worker process, OpenAI-compatible servers, Ollama."""
