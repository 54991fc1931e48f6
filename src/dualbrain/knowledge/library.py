"""The front door of knowledge: add, search, quote, remove (paper 5: rules, manuals, maps, task templates)."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Literal, Self

import numpy as np

from dualbrain.core.encoder import Encoder, Rows
from dualbrain.errors import InvalidSetup, UnknownName
from dualbrain.knowledge.chunking import Chunk, chunks
from dualbrain.knowledge.document import DOCUMENT, KINDS, TRUST, Citation, Document, Hit, Kind, Trust
from dualbrain.knowledge.readers.reader import Reading, read
from dualbrain.knowledge.rejection import Refused
from dualbrain.knowledge.store import Shelf, Shelved
from dualbrain.knowledge.structured.kinds import check_structure, default_kind

By = Literal["both", "words", "meaning"]
Change = Literal["new", "new version", "restored", "relabelled", "unchanged"]

DEEPEST = 50
"""How many chunks the ranking by words may hold, and how many of one document a search gives unless told."""
LONGEST_QUERY = 2000
_ARTICLES = "a an the this that these they them their there it its i me my we our you your who which what"
_VERBS = "am is are was be been can could do does did had has have may should will would please"
_LINKS = "and any as at but by for from how if in into no not of on or so than then to when where why with"
_WORDS = re.compile(r"^(?:use_when|about|use)\s*=\s*\"([^\"\n]*)\"", re.MULTILINE)
COMMON = frozenset(f"{_ARTICLES} {_VERBS} {_LINKS}".split())
"""Words of a question that say nothing about what is asked; in a small library their BM25 is not near zero."""


@dataclass(frozen=True, slots=True)
class Submission:
    """What is to be added: the bytes of `file`; the rest may be left to what the file says of itself."""

    file: str
    data: bytes
    trust: Trust = "unknown"
    name: str = ""
    kind: Kind | None = None
    title: str = ""
    bodies: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Addition:
    """What adding did."""

    document: Document
    change: Change


class Library:
    """One store and one encoder. Knowledge is not a controller: it returns quotations, and imports nothing that moves.

    Knowledge is never reweighed by outcomes, because a rule must not change by what happened.
    """

    def __init__(self, path: Path, encoder: Encoder | None, *, write: bool = False) -> None:
        """Open the store at `path`; without an encoder it can only be searched by words.

        Raises what `Shelf` raises, and `InvalidSetup` if its vectors were made by another encoder.
        """
        self._shelf, self._encoder = Shelf(path, write=write), encoder
        made = self._shelf.embedder()
        if encoder is not None and made not in {"", maker(encoder)} and not write:
            self._shelf.close()
            raise _mixed(made, encoder)
        self._load()

    def _load(self) -> None:
        self._chunks = {one.id: one for one in self._shelf.chunks()}
        stored = self._shelf.vectors()
        self._ids = np.array([number for number in self._chunks if number in stored], np.int64)
        flat = b"".join(stored[int(number)] for number in self._ids)
        self._rows: Rows = np.frombuffer(flat, "<f4").reshape(len(self._ids), -1) if flat else np.empty((0, 0), "<f4")

    def __len__(self) -> int:
        return len(self._chunks)

    # --- look -------------------------------------------------------------------------------------------------------

    def documents(self) -> tuple[Document, ...]:
        """What stands on the shelf, by name."""
        return tuple(self._shelf.documents().values())

    def document(self, name: str) -> Document:
        """The document called `name`; raises `UnknownName`."""
        known = self._shelf.documents()
        if name not in known:
            raise UnknownName("document", name, tuple(known))
        return known[name]

    def history(self, name: str) -> tuple[tuple[float, Document | None], ...]:
        """Every version of `name` and when it was put up, or taken down (None), oldest first."""
        return self._shelf.history(name)

    def reading(self, name: str, version: str = "") -> Reading:
        """The text of `name` as it stands, or of any older `version`; raises `UnknownName`."""
        found = self._shelf.readings(name, version or self.document(name).version)
        if len(found) != 1:
            known = tuple(one.version[:12] for _, one in self.history(name) if one)
            raise UnknownName("version", version, known, owner=name)
        return found[0]

    def quote(self, citation: Citation) -> str | Refused:
        """Exactly the characters that `citation` names, also of versions that stand on the shelf no more."""
        found = self._shelf.readings(citation.document, citation.version)
        if len(found) != 1:
            got = f"{citation}: {len(found)} versions"
            return Refused("citation", got, "a document and version of this store")
        text = found[0].text
        if not 0 <= citation.start < citation.end <= len(text):
            return Refused("citation", str(citation), f"offsets within 0 … {len(text)}")
        return text[citation.start : citation.end]

    def chunks_of(self, name: str) -> tuple[tuple[Citation, str], ...]:
        """The chunks of a document that stands on the shelf, with their citations."""
        return tuple((cited(one), one.text) for one in self._chunks.values() if one.document.name == name)

    def search(
        self, query: str, k: int = 5, *, by: By = "both", kinds: Sequence[Kind] = KINDS, least: Trust = "unknown",
        body: str = "", per_document: int = DEEPEST,
    ) -> tuple[Hit, ...]:  # fmt: skip
        """The k best chunks of these `kinds`, trusted at least as much as `least`, best first; ties by document order.

        With `body`, documents about other robots are left out. At most `per_document` chunks of one document are given,
        so that none can crowd the others out.

        "both" fuses the ranking by words and by meaning (see `fusion`). The score is multiplied by what the source's
        trust is worth. Raises `InvalidSetup` when meaning is asked for and there is no encoder or no vector.
        """
        allowed = {
            number
            for number, one in self._chunks.items()
            if one.document.kind in kinds
            and TRUST[one.document.trust] >= TRUST[least]
            and (not body or not one.document.bodies or body in one.document.bodies)
        }
        words = self._by_words(query, allowed) if by != "meaning" else {}
        meaning = self._by_meaning(query, allowed) if by != "words" else {}
        match by:
            case "both":
                scores = normalised(words, meaning)
            case "words":
                scores = words
            case "meaning":
                scores = meaning
        weighed = {number: score * TRUST[self._chunks[number].document.trust] for number, score in scores.items()}
        best = self._spread(sorted(weighed, key=lambda number: (-weighed[number], number)), per_document)[:k]
        return tuple(self._hit(number, weighed[number], meaning.get(number), words.get(number)) for number in best)

    def _spread(self, ranked: list[int], per_document: int) -> list[int]:
        """`ranked` without what is more than `per_document` of one document."""
        seen: Counter[str] = Counter()
        kept: list[int] = []
        for number in ranked:
            name = self._chunks[number].document.name
            seen[name] += 1
            if seen[name] <= per_document:
                kept.append(number)
        return kept

    def _by_words(self, query: str, allowed: set[int]) -> dict[int, float]:
        """BM25 over the words of the query, each of them optional."""
        said = re.findall(r"\w+", query[:LONGEST_QUERY].lower().replace("_", " "))
        terms = [term for term in dict.fromkeys(said) if term not in COMMON]
        if not terms:
            return {}
        found = self._shelf.match(" OR ".join(f'"{term}"' for term in terms), len(self._chunks))
        return _first({number: score for number, score in found.items() if number in allowed})

    def _by_meaning(self, query: str, allowed: set[int]) -> dict[int, float]:
        """Cosine of the query with every chunk, best first."""
        if self._encoder is None:
            raise InvalidSetup("search by meaning", got="no sentence encoder", allowed="search by words")
        made = self._shelf.embedder()
        if made not in {"", maker(self._encoder)}:
            raise _mixed(made, self._encoder)
        if not len(self._ids):
            return {}
        cosine = self._rows @ self._encoder.encode([query[:LONGEST_QUERY]])[0]
        order = np.lexsort((self._ids, -cosine))
        return {int(self._ids[row]): float(cosine[row]) for row in order if int(self._ids[row]) in allowed}

    def _hit(self, number: int, score: float, likeness: float | None, words: float | None) -> Hit:
        one = self._chunks[number]
        document = one.document
        where = (cited(one), document.kind, document.trust, document.title, one.chunk.path, one.text)
        return Hit(*where, score=score, likeness=likeness, words=words)

    # --- change -----------------------------------------------------------------------------------------------------

    def add(self, submission: Submission, *, now: float) -> Addition | Refused:
        """Put a document on the shelf at `now` [s, 1970 UTC], or say why not; a changed one is a new version."""
        encoder = self._writing()
        reading = read(submission.data, submission.file)
        if isinstance(reading, Refused):
            return reading
        name = submission.name or _name_of(submission.file)
        if not DOCUMENT.fullmatch(name):
            return Refused("name", ascii(name[:60])[1:-1], f"an identifier, {DOCUMENT.pattern}", "Name it with --name.")
        kind = submission.kind or default_kind(reading)
        if refused := check_structure(kind, reading):
            return refused
        pieces = self._shelf.pieces(name, reading.version) or chunks(reading)
        document = Document(
            name, reading.version, kind, submission.trust, submission.title or _title_of(reading, name), reading.media,
            Path(submission.file).name, now, reading.source, len(reading.text), len(pieces), reading.hidden,
            submission.bodies,
        )  # fmt: skip
        change = _change([one for _, one in self.history(name)], document)
        if change != "unchanged":
            rows = encoder.encode(
                [embedded_text(document.title, one, reading.text[one.start : one.end]) for one in pieces]
            )
            with self._shelf.transaction():
                numbers = self._shelf.keep(name, reading, pieces)
                self._shelf.put(document, now=now)
                self._shelf.project(maker(encoder), dict(zip(numbers, rows, strict=True)))
            self._load()
        return Addition(document, change)

    def remove(self, name: str, *, now: float) -> Document:
        """Take a document down at `now`; what was cited of it can still be quoted. Raises `UnknownName`."""
        encoder = self._writing()
        document = self.document(name)
        with self._shelf.transaction():
            self._shelf.take_down(name, now=now)
            self._shelf.project(maker(encoder), {})
        self._load()
        return document

    def rebuild(self) -> int:
        """Make words and vectors of everything again, with this encoder; returns the number of chunks."""
        if self._encoder is None:
            raise InvalidSetup("rebuild", got="no sentence encoder", allowed="an encoder")
        with self._shelf.transaction():
            live = self._shelf.chunks()
            texts = [embedded_text(one.document.title, one.chunk, one.text) for one in live]
            self._shelf.forget_projections()
            self._shelf.project(
                maker(self._encoder), dict(zip((one.id for one in live), self._encoder.encode(texts), strict=True))
            )
        self._load()
        return len(self)

    def _writing(self) -> Encoder:
        """The encoder, if it may add to what is there."""
        if self._encoder is None:
            raise InvalidSetup("knowledge store", got="no sentence encoder", allowed="an encoder, to write")
        made = self._shelf.embedder()
        if made not in {"", maker(self._encoder)}:
            raise _mixed(made, self._encoder)
        return self._encoder

    def close(self) -> None:
        """Close the store."""
        self._shelf.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, trace: TracebackType | None) -> None:
        self.close()


def cited(one: Shelved) -> Citation:
    """Where a chunk stands."""
    return Citation(one.document.name, one.document.version, one.chunk.start, one.chunk.end, one.chunk.page)


def maker(encoder: Encoder) -> str:
    """Who made a vector: the encoder, and the way in which a chunk is put to it (see `embedded_text`)."""
    return f"{encoder.id}, recipe 1"


def embedded_text(title: str, chunk: Chunk, text: str) -> str:
    """What the encoder reads of a chunk: the headings above it, or the title, say what it is about.

    Of an entry of a TOML file only its words: the numbers of a pose or a contract are looked up, not embedded.
    """
    words = _WORDS.findall(text) if text.startswith("[[") else [text]
    return ". ".join((*(chunk.path[-2:] or (title,)), *words))


def _first(ranking: dict[int, float]) -> dict[int, float]:
    return dict(list(ranking.items())[:DEEPEST])


def _change(history: list[Document | None], document: Document) -> Change:
    if not history:
        return "new"
    last = history[-1]
    if last is None or last.version != document.version:
        seen = any(one is not None and one.version == document.version for one in history)
        return "restored" if seen else "new version"
    labels = [(one.kind, one.trust, one.title, one.bodies) for one in (last, document)]
    return "unchanged" if labels[0] == labels[1] else "relabelled"


def _name_of(file: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", Path(file).stem.lower()).strip("-")[:48]


def _title_of(reading: Reading, name: str) -> str:
    """The first heading, or the title that a map or a template document gives itself."""
    pattern = r"^#\s+(.+)$" if reading.media in {"markdown", "html"} else r"^\s*\"?title\"?\s*[=:]\s*\"([^\"\n]+)\""
    found = re.search(pattern, reading.text, re.MULTILINE)
    return " ".join((found[1] if found else name).split())[:120]


def _mixed(made: str, encoder: Encoder) -> InvalidSetup:
    return InvalidSetup(
        "vectors of the knowledge store", got=made, allowed=f"made by {maker(encoder)}",
        fix="Make them again with `dualbrain knowledge rebuild`.",
    )  # fmt: skip


SHARE = 0.7
"""Share of meaning in the fused score; docs/knowledge.md has the measurement."""


def normalised(words: Mapping[int, float], meaning: Mapping[int, float], share: float = SHARE) -> dict[int, float]:
    """score(d) = (1 − share) bm25(d)/max bm25 + share max(0, cos(d)): absolute in meaning, relative in words."""
    best = max(words.values(), default=0.0)
    return {
        item: (1.0 - share) * (words.get(item, 0.0) / best if best > 0.0 else 0.0)
        + share * max(0.0, meaning.get(item, 0.0))
        for item in {*words, *meaning}
    }
