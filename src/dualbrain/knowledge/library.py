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

from dualbrain.core.encoder import Encoder, Float32Array
from dualbrain.errors import ConfigurationError, UnknownNameError
from dualbrain.knowledge.chunking import Chunk, split_chunks
from dualbrain.knowledge.document import (
    DOCUMENT_KINDS,
    DOCUMENT_NAME_PATTERN,
    TRUST_WEIGHTS,
    ChunkHit,
    Citation,
    Document,
    DocumentKind,
    TrustLevel,
)
from dualbrain.knowledge.readers.reader import DocumentText, read_document
from dualbrain.knowledge.rejection import DocumentRejected
from dualbrain.knowledge.store import DocumentStore, StoredChunk
from dualbrain.knowledge.structured.kinds import check_structure, default_kind

SearchMode = Literal["both", "words", "meaning"]
AdditionKind = Literal["new", "new version", "restored", "relabelled", "unchanged"]

MAX_RANKED_CHUNKS = 50
"""How many chunks the ranking by words may hold, and how many of one document a search gives unless told."""
MAX_QUERY_CHARACTERS = 2000
_ARTICLES = "a an the this that these they them their there it its i me my we our you your who which what"
_VERBS = "am is are was be been can could do does did had has have may should will would please"
_LINKS = "and any as at but by for from how if in into no not of on or so than then to when where why with"
_TOML_TEXT_FIELDS = re.compile(r"^(?:use_when|about|use)\s*=\s*\"([^\"\n]*)\"", re.MULTILINE)
STOP_WORDS = frozenset(f"{_ARTICLES} {_VERBS} {_LINKS}".split())
"""Words of a question that say nothing about what is asked; in a small library their BM25 is not near zero."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Submission:
    """What is to be added: the bytes of `file`; the rest may be left to what the file says of itself."""

    file: str
    data: bytes
    trust: TrustLevel = "unknown"
    name: str = ""
    kind: DocumentKind | None = None
    title: str = ""
    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Addition:
    """What adding did."""

    document: Document
    change: AdditionKind


class Library:
    """One store and one encoder. Knowledge is not a controller: it returns quotations, and imports nothing that moves.

    Knowledge is never reweighed by outcomes, because a rule must not change by what happened.
    """

    def __init__(self, path: Path, encoder: Encoder | None, *, write: bool = False) -> None:
        """Open the store at `path`; without an encoder it can only be searched by words.

        Raises what `Shelf` raises, and `InvalidSetup` if its vectors were made by another encoder.
        """
        self._store, self._encoder = DocumentStore(path, write=write), encoder
        made = self._store.embedder()
        if encoder is not None and made not in {"", embedder_id(encoder)} and not write:
            self._store.close()
            raise _encoder_mismatch(made, encoder)
        self._load()

    def _load(self) -> None:
        self._chunks = {one.id: one for one in self._store.chunks()}
        stored = self._store.vectors()
        self._ids = np.array([number for number in self._chunks if number in stored], np.int64)
        flat = b"".join(stored[int(number)] for number in self._ids)
        self._rows: Float32Array = (
            np.frombuffer(flat, "<f4").reshape(len(self._ids), -1) if flat else np.empty((0, 0), "<f4")
        )

    def __len__(self) -> int:
        return len(self._chunks)

    # --- look -------------------------------------------------------------------------------------------------------

    def documents(self) -> tuple[Document, ...]:
        """What stands on the shelf, by name."""
        return tuple(self._store.documents().values())

    def document(self, name: str) -> Document:
        """The document called `name`; raises `UnknownName`."""
        known = self._store.documents()
        if name not in known:
            raise UnknownNameError("document", name, tuple(known))
        return known[name]

    def history(self, name: str) -> tuple[tuple[float, Document | None], ...]:
        """Every version of `name` and when it was put up, or taken down (None), oldest first."""
        return self._store.history(name)

    def document_text(self, name: str, version: str = "") -> DocumentText:
        """The text of `name` as it stands, or of any older `version`; raises `UnknownName`."""
        found = self._store.document_texts(name, version or self.document(name).version)
        if len(found) != 1:
            known = tuple(one.version[:12] for _, one in self.history(name) if one)
            raise UnknownNameError("version", version, known, owner=name)
        return found[0]

    def quote(self, citation: Citation) -> str | DocumentRejected:
        """Exactly the characters that `citation` names, also of versions that stand on the shelf no more."""
        found = self._store.document_texts(citation.document, citation.version)
        if len(found) != 1:
            got = f"{citation}: {len(found)} versions"
            return DocumentRejected("citation", got, "a document and version of this store")
        text = found[0].text
        if not 0 <= citation.start < citation.end <= len(text):
            return DocumentRejected("citation", str(citation), f"offsets within 0 … {len(text)}")
        return text[citation.start : citation.end]

    def chunks_of(self, name: str) -> tuple[tuple[Citation, str], ...]:
        """The chunks of a document that stands on the shelf, with their citations."""
        return tuple((chunk_citation(one), one.text) for one in self._chunks.values() if one.document.name == name)

    def search(
        self,
        query: str,
        k: int = 5,
        *,
        mode: SearchMode = "both",
        kinds: Sequence[DocumentKind] = DOCUMENT_KINDS,
        min_trust: TrustLevel = "unknown",
        robot: str = "",
        per_document: int = MAX_RANKED_CHUNKS,
    ) -> tuple[ChunkHit, ...]:
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
            and TRUST_WEIGHTS[one.document.trust] >= TRUST_WEIGHTS[min_trust]
            and (not robot or not one.document.robots or robot in one.document.robots)
        }
        words = self._search_words(query, allowed) if mode != "meaning" else {}
        meaning = self._search_embeddings(query, allowed) if mode != "words" else {}
        match mode:
            case "both":
                scores = fuse_scores(words, meaning)
            case "words":
                scores = words
            case "meaning":
                scores = meaning
        weighed = {
            number: score * TRUST_WEIGHTS[self._chunks[number].document.trust] for number, score in scores.items()
        }
        best = self._limit_per_document(sorted(weighed, key=lambda number: (-weighed[number], number)), per_document)[
            :k
        ]
        return tuple(self._hit(number, weighed[number], meaning.get(number), words.get(number)) for number in best)

    def _limit_per_document(self, ranked: list[int], per_document: int) -> list[int]:
        """`ranked` without what is more than `per_document` of one document."""
        seen: Counter[str] = Counter()
        kept: list[int] = []
        for number in ranked:
            name = self._chunks[number].document.name
            seen[name] += 1
            if seen[name] <= per_document:
                kept.append(number)
        return kept

    def _search_words(self, query: str, allowed: set[int]) -> dict[int, float]:
        """BM25 over the words of the query, each of them optional."""
        said = re.findall(r"\w+", query[:MAX_QUERY_CHARACTERS].lower().replace("_", " "))
        terms = [term for term in dict.fromkeys(said) if term not in STOP_WORDS]
        if not terms:
            return {}
        found = self._store.search_words(" OR ".join(f'"{term}"' for term in terms), len(self._chunks))
        return _truncate_ranking({number: score for number, score in found.items() if number in allowed})

    def _search_embeddings(self, query: str, allowed: set[int]) -> dict[int, float]:
        """Cosine of the query with every chunk, best first."""
        if self._encoder is None:
            raise ConfigurationError("search by meaning", got="no sentence encoder", allowed="search by words")
        made = self._store.embedder()
        if made not in {"", embedder_id(self._encoder)}:
            raise _encoder_mismatch(made, self._encoder)
        if not len(self._ids):
            return {}
        cosine = self._rows @ self._encoder.encode([query[:MAX_QUERY_CHARACTERS]])[0]
        order = np.lexsort((self._ids, -cosine))
        return {int(self._ids[row]): float(cosine[row]) for row in order if int(self._ids[row]) in allowed}

    def _hit(self, number: int, score: float, likeness: float | None, words: float | None) -> ChunkHit:
        one = self._chunks[number]
        document = one.document
        return ChunkHit(
            citation=chunk_citation(one),
            kind=document.kind,
            trust=document.trust,
            title=document.title,
            path=one.chunk.path,
            text=one.text,
            score=score,
            likeness=likeness,
            bm25_score=words,
        )

    # --- change -----------------------------------------------------------------------------------------------------

    def add(self, submission: Submission, *, now: float) -> Addition | DocumentRejected:
        """Put a document on the shelf at `now` [s, 1970 UTC], or say why not; a changed one is a new version."""
        encoder = self._require_encoder()
        reading = read_document(submission.data, submission.file)
        if isinstance(reading, DocumentRejected):
            return reading
        name = submission.name or _default_name(submission.file)
        if not DOCUMENT_NAME_PATTERN.fullmatch(name):
            return DocumentRejected(
                "name",
                ascii(name[:60])[1:-1],
                f"an identifier, {DOCUMENT_NAME_PATTERN.pattern}",
                "Name it with --name.",
            )
        kind = submission.kind or default_kind(reading)
        if refused := check_structure(kind, reading):
            return refused
        pieces = self._store.stored_chunks(name, reading.version) or split_chunks(reading)
        document = Document(
            name=name,
            version=reading.version,
            kind=kind,
            trust=submission.trust,
            title=submission.title or _default_title(reading, name),
            media=reading.media,
            file=Path(submission.file).name,
            added=now,
            source=reading.source,
            characters=len(reading.text),
            chunks=len(pieces),
            hidden=reading.hidden,
            robots=submission.robots,
        )
        change = _classify_addition([one for _, one in self.history(name)], document)
        if change != "unchanged":
            rows = encoder.encode(
                [embedding_text(document.title, one, reading.text[one.start : one.end]) for one in pieces]
            )
            with self._store.transaction():
                numbers = self._store.store_text(name, reading, pieces)
                self._store.publish(document, now=now)
                self._store.update_projections(embedder_id(encoder), dict(zip(numbers, rows, strict=True)))
            self._load()
        return Addition(document, change)

    def remove(self, name: str, *, now: float) -> Document:
        """Take a document down at `now`; what was cited of it can still be quoted. Raises `UnknownName`."""
        encoder = self._require_encoder()
        document = self.document(name)
        with self._store.transaction():
            self._store.withdraw(name, now=now)
            self._store.update_projections(embedder_id(encoder), {})
        self._load()
        return document

    def rebuild(self) -> int:
        """Make words and vectors of everything again, with this encoder; returns the number of chunks."""
        if self._encoder is None:
            raise ConfigurationError("rebuild", got="no sentence encoder", allowed="an encoder")
        with self._store.transaction():
            live = self._store.chunks()
            texts = [embedding_text(one.document.title, one.chunk, one.text) for one in live]
            self._store.clear_projections()
            self._store.update_projections(
                embedder_id(self._encoder),
                dict(zip((one.id for one in live), self._encoder.encode(texts), strict=True)),
            )
        self._load()
        return len(self)

    def _require_encoder(self) -> Encoder:
        """The encoder, if it may add to what is there."""
        if self._encoder is None:
            raise ConfigurationError("knowledge store", got="no sentence encoder", allowed="an encoder, to write")
        made = self._store.embedder()
        if made not in {"", embedder_id(self._encoder)}:
            raise _encoder_mismatch(made, self._encoder)
        return self._encoder

    def close(self) -> None:
        """Close the store."""
        self._store.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, trace: TracebackType | None) -> None:
        self.close()


def chunk_citation(one: StoredChunk) -> Citation:
    """Where a chunk stands."""
    return Citation(
        document=one.document.name,
        version=one.document.version,
        start=one.chunk.start,
        end=one.chunk.end,
        page=one.chunk.page,
    )


def embedder_id(encoder: Encoder) -> str:
    """Who made a vector: the encoder, and the way in which a chunk is put to it (see `embedded_text`)."""
    return f"{encoder.id}, recipe 1"


def embedding_text(title: str, chunk: Chunk, text: str) -> str:
    """What the encoder reads of a chunk: the headings above it, or the title, say what it is about.

    Of an entry of a TOML file only its words: the numbers of a pose or a contract are looked up, not embedded.
    """
    words = _TOML_TEXT_FIELDS.findall(text) if text.startswith("[[") else [text]
    return ". ".join((*(chunk.path[-2:] or (title,)), *words))


def _truncate_ranking(ranking: dict[int, float]) -> dict[int, float]:
    return dict(list(ranking.items())[:MAX_RANKED_CHUNKS])


def _classify_addition(history: list[Document | None], document: Document) -> AdditionKind:
    if not history:
        return "new"
    last = history[-1]
    if last is None or last.version != document.version:
        seen = any(one is not None and one.version == document.version for one in history)
        return "restored" if seen else "new version"
    labels = [(one.kind, one.trust, one.title, one.robots) for one in (last, document)]
    return "unchanged" if labels[0] == labels[1] else "relabelled"


def _default_name(file: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", Path(file).stem.lower()).strip("-")[:48]


def _default_title(reading: DocumentText, name: str) -> str:
    """The first heading, or the title that a map or a template document gives itself."""
    pattern = r"^#\s+(.+)$" if reading.media in {"markdown", "html"} else r"^\s*\"?title\"?\s*[=:]\s*\"([^\"\n]+)\""
    found = re.search(pattern, reading.text, re.MULTILINE)
    return " ".join((found[1] if found else name).split())[:120]


def _encoder_mismatch(made: str, encoder: Encoder) -> ConfigurationError:
    return ConfigurationError(
        "vectors of the knowledge store",
        got=made,
        allowed=f"made by {embedder_id(encoder)}",
        fix="Make them again with `dualbrain knowledge rebuild`.",
    )


SEMANTIC_WEIGHT = 0.7
"""Share of meaning in the fused score; docs/explanation/knowledge.md has the measurement."""


def fuse_scores(
    bm25: Mapping[int, float], cosine: Mapping[int, float], semantic_weight: float = SEMANTIC_WEIGHT
) -> dict[int, float]:
    """score(d) = (1 − share) bm25(d)/max bm25 + share max(0, cos(d)): absolute in meaning, relative in words."""
    best = max(bm25.values(), default=0.0)
    return {
        item: (1.0 - semantic_weight) * (bm25.get(item, 0.0) / best if best > 0.0 else 0.0)
        + semantic_weight * max(0.0, cosine.get(item, 0.0))
        for item in {*bm25, *cosine}
    }
