"""The words of an instruction, read by local rules: stop words, clauses, hostile requests, language, named objects."""
