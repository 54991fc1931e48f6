"""Bad values in bytes and texts from outside: contracts, messages, files, recordings, documents and requests."""
