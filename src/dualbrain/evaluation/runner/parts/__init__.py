"""Parts of an evaluation that run on different machines, and their merge."""
