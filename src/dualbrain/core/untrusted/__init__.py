"""Reading of untrusted files and texts: bounded files, bounded processes, bounded TOML, and hidden characters."""
