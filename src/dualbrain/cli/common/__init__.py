"""Parts that several commands use: console, exit codes, paths, signals."""
