"""Adds documents and prints the number of each acknowledged one, until the process is killed."""

import sys
from pathlib import Path

from dualbrain.knowledge.library import Library, Submission
from dualbrain.memory.embedding.hashing_encoder import HashingEncoder

with Library(Path(sys.argv[1]), HashingEncoder(16), write=True) as library:
    for number in range(10_000):
        words = f"# Document {number}\n\nIt contains {number} and nothing else that a reader would need.\n"
        library.add(Submission(file=f"d{number % 7}.md", data=words.encode(), trust="site"), now=float(number))
        sys.stdout.write(f"{number}\n")
        sys.stdout.flush()
