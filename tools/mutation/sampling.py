"""Mutants from a seed: which file, which kind of mistake, where, and what stands there instead."""

from __future__ import annotations

import hashlib
import random
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from pathlib import Path

from tools.mutation.mutation_sites import KINDS, Site
from tools.mutation.tokens import tokenize

SOURCES = ("kernel/src/**/*.c", "src/dualbrain/safety/cbf/kernel.py")


@dataclass(frozen=True, slots=True)
class Mutant:
    """One change: `file` is relative to the root; `before` and `after` are the whole lines, without indentation."""

    file: str
    line: int
    kind: str
    before: str
    after: str
    text: str

    @property
    def key(self) -> str:
        """A short name that stays the same while the file does."""
        return hashlib.sha256(f"{self.file}|{self.kind}|{self.text}".encode()).hexdigest()[:12]

    def record(self) -> dict[str, object]:
        """What the journal keeps: all but the text of the whole file."""
        return {name: value for name, value in asdict(self).items() if name != "text"}


def source_files(root: Path, patterns: tuple[str, ...] = SOURCES) -> list[Path]:
    """The files that mistakes are made in, sorted."""
    return sorted(path for pattern in patterns for path in root.glob(pattern))


def find_sites(source: str, suffix: str) -> dict[str, list[Site]]:
    """Every place of a source that can be changed, by kind; kinds without one are left out."""
    words = tokenize(source, suffix)
    found = {kind: list(where(source, words)) for kind, where in KINDS.items()}
    return {kind: places for kind, places in found.items() if places}


def make_mutant(file: str, source: str, kind: str, site: Site, choice: str) -> Mutant:
    """The mutant with `choice` at `site`."""
    start, end, _ = site
    text = source[:start] + choice + source[end:]
    first = source.rfind("\n", 0, start) + 1
    last = source.find("\n", end)
    before, after = source[first:last], text[first : last + len(text) - len(source)]
    line = source.count("\n", 0, start) + 1
    return Mutant(file, line, kind, collapse_whitespace(before), collapse_whitespace(after), text)


def collapse_whitespace(text: str) -> str:
    """Several lines in one, single spaces."""
    return " ".join(text.split())


def sample_mutants(root: Path, seed: int, patterns: tuple[str, ...] = SOURCES) -> Iterator[Mutant]:
    """An endless stream without repetition: files take turns, and so do kinds within a file."""
    chance = random.Random(seed)
    sources = {str(path.relative_to(root)): path.read_text() for path in source_files(root, patterns)}
    left = {file: _shuffle_kinds(find_sites(text, Path(file).suffix), chance) for file, text in sources.items()}
    seen: set[str] = set()
    while any(left.values()):
        round_of_files = [file for file, kinds in left.items() if kinds]
        chance.shuffle(round_of_files)
        for file in round_of_files:
            kind, site = _draw_site(left[file], chance)
            mutant = make_mutant(file, sources[file], kind, site, chance.choice(site[2]))
            if mutant.key not in seen:
                seen.add(mutant.key)
                yield mutant


def _shuffle_kinds(kinds: dict[str, list[Site]], chance: random.Random) -> dict[str, list[Site]]:
    return {kind: kinds[kind] for kind in chance.sample(list(kinds), len(kinds))}


def _draw_site(kinds: dict[str, list[Site]], chance: random.Random) -> tuple[str, Site]:
    """A kind and a site of it; the site is used up, and the kind goes to the end of the queue."""
    kind = chance.choice(list(kinds)[: max(1, len(kinds) // 2)])
    places = kinds.pop(kind)
    site = places.pop(chance.randrange(len(places)))
    if places:
        kinds[kind] = places
    return kind, site
