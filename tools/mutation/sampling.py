"""Random mutants from a seed: file, kind of fault, position and replacement."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from tools.mutation.mutation_sites import KINDS, Site
from tools.mutation.tokens import tokenize

SOURCES = ("kernel/src/**/*.c", "src/dualbrain/safety/cbf/kernel.py")


@dataclass(frozen=True, slots=True, kw_only=True)
class Mutant:
    """One change: `file` relative to the root, whole lines `before` and `after`, whole mutated file `text`."""

    file: str
    line: int
    kind: str
    before: str
    after: str
    text: str

    @property
    def key(self) -> str:
        """Short name, constant while the file is unchanged."""
        return hashlib.sha256(f"{self.file}|{self.kind}|{self.text}".encode()).hexdigest()[:12]

    def record(self) -> dict[str, object]:
        """Return the fields for the log: all except the text of the whole file."""
        return {name: value for name, value in asdict(self).items() if name != "text"}


def source_files(root: Path, patterns: tuple[str, ...] = SOURCES) -> list[Path]:
    """Return the files to mutate, sorted."""
    return sorted(path for pattern in patterns for path in root.glob(pattern))


def find_sites(source: str, suffix: str) -> dict[str, list[Site]]:
    """Return all mutation sites of a source by kind, without empty kinds."""
    tokens = tokenize(source, suffix)
    found = {kind: list(find(source, tokens)) for kind, find in KINDS.items()}
    return {kind: sites for kind, sites in found.items() if sites}


def make_mutant(file: str, source: str, kind: str, site: Site, choice: str) -> Mutant:
    """Return the mutant that replaces the text at `site` with `choice`."""
    start, end, _ = site
    text = source[:start] + choice + source[end:]
    first = source.rfind("\n", 0, start) + 1
    last = source.find("\n", end)
    before, after = source[first:last], text[first : last + len(text) - len(source)]
    line = source.count("\n", 0, start) + 1
    return Mutant(
        file=file, line=line, kind=kind, before=collapse_whitespace(before), after=collapse_whitespace(after), text=text
    )


def collapse_whitespace(text: str) -> str:
    """Join lines, with single spaces."""
    return " ".join(text.split())


def sample_mutants(root: Path, seed: int, patterns: tuple[str, ...] = SOURCES) -> Iterator[Mutant]:
    """Yield mutants without repetition until all sites are used; files alternate, and so do kinds within a file."""
    rng = random.Random(seed)
    sources = {str(path.relative_to(root)): path.read_text() for path in source_files(root, patterns)}
    remaining = {file: _shuffle_kinds(find_sites(text, Path(file).suffix), rng) for file, text in sources.items()}
    seen: set[str] = set()
    while any(remaining.values()):
        round_of_files = [file for file, kinds in remaining.items() if kinds]
        rng.shuffle(round_of_files)
        for file in round_of_files:
            kind, site = _draw_site(remaining[file], rng)
            mutant = make_mutant(file, sources[file], kind, site, rng.choice(site[2]))
            if mutant.key not in seen:
                seen.add(mutant.key)
                yield mutant


def _shuffle_kinds(kinds: dict[str, list[Site]], rng: random.Random) -> dict[str, list[Site]]:
    return {kind: kinds[kind] for kind in rng.sample(list(kinds), len(kinds))}


def _draw_site(kinds: dict[str, list[Site]], rng: random.Random) -> tuple[str, Site]:
    """Remove and return a site and its kind; the kind moves to the end of the queue."""
    kind = rng.choice(list(kinds)[: max(1, len(kinds) // 2)])
    sites = kinds.pop(kind)
    site = sites.pop(rng.randrange(len(sites)))
    if sites:
        kinds[kind] = sites
    return kind, site
