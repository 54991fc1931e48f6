"""robot-dam 0.7.0 (PyPI, MPL-2.0) in a virtual environment of its own, as an outside guard."""
