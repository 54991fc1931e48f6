"""Who proposes: the prompt and the language models behind one protocol."""
