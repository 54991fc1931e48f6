"""The document library: add, search, quote and remove documents (paper 5: rules, manuals, maps, task templates)."""

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
from dualbrain.core.text import storable_text
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
"""Largest number of chunks in the ranking by words, and default limit for the hits from one document."""
MAX_QUERY_CHARACTERS = 2000
_ARTICLES = "a an the this that these they them their there it its i me my we our you your who which what"
_VERBS = "am is are was be been can could do does did had has have may should will would please"
_LINKS = "and any as at but by for from how if in into no not of on or so than then to when where why with"
_TOML_TEXT_FIELDS = re.compile(r"^(?:use_when|about|use)\s*=\s*\"([^\"\n]*)\"", re.MULTILINE)
STOP_WORDS = frozenset(f"{_ARTICLES} {_VERBS} {_LINKS}".split())
"""Words that carry no information about the subject of a query; in a small library their BM25 is not near zero."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Submission:
    """A document to be added: the bytes of `file`, and labels; name, kind and title have defaults from the file."""

    file: str
    data: bytes
    trust: TrustLevel = "unknown"
    name: str = ""
    kind: DocumentKind | None = None
    title: str = ""
    robots: tuple[str, ...] = ()


@dataclass(frozen=True, slots=True)
class Addition:
    """Result of an addition: the document, and the change in the library."""

    document: Document
    change: AdditionKind


class Library:
    """Documents in one store, searched with one encoder.

    The library is not a controller: it returns quotations, and imports no module that moves a robot. Outcomes never
    change the ranking of documents, because a rule must not depend on past events.
    """

    def __init__(self, path: Path, encoder: Encoder | None, *, write: bool = False) -> None:
        """Open the store at `path`; without an encoder it can only be searched by words.

        Raises the errors of `DocumentStore`, and `ConfigurationError` if the vectors were computed by another encoder.
        """
        self._store, self._encoder = DocumentStore(path, write=write), encoder
        embedder = self._store.embedder()
        if encoder is not None and embedder not in {"", embedder_id(encoder)} and not write:
            self._store.close()
            raise _encoder_mismatch(embedder, encoder)
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

    # --- read -------------------------------------------------------------------------------------------------------

    def documents(self) -> tuple[Document, ...]:
        """The published documents, in the order of their names."""
        return tuple(self._store.documents().values())

    def document(self, name: str) -> Document:
        """The published document `name`; raises `UnknownNameError`."""
        known = self._store.documents()
        if name not in known:
            raise UnknownNameError("document", name, tuple(known))
        return known[name]

    def history(self, name: str) -> tuple[tuple[float, Document | None], ...]:
        """Time [s, 1970 UTC] and document of each publication of `name`, None for a removal; oldest first."""
        return self._store.history(name)

    def document_text(self, name: str, version: str = "") -> DocumentText:
        """The text of `name` in the published or another `version`; raises `UnknownNameError`."""
        found = self._store.document_texts(name, version or self.document(name).version)
        if len(found) != 1:
            known = tuple(one.version[:12] for _, one in self.history(name) if one)
            raise UnknownNameError("version", version, known, owner=name)
        return found[0]

    def quote(self, citation: Citation) -> str | DocumentRejected:
        """The exact characters that `citation` names, also of old versions and removed documents.

        A page in the citation must be that of its first character.
        """
        found = self._store.document_texts(citation.document, citation.version)
        if len(found) != 1:
            got = f"{citation}: {len(found)} versions"
            return DocumentRejected("citation", got, "a document and version of this store")
        text = found[0].text
        if not 0 <= citation.start < citation.end <= len(text):
            return DocumentRejected("citation", str(citation), f"offsets within 0 … {len(text)}")
        if citation.page not in (None, page := found[0].page_at(citation.start)):
            allowed = "no page: the document has none" if page is None else f"page {page} for this offset"
            return DocumentRejected("citation", str(citation), allowed)
        return text[citation.start : citation.end]

    def chunks_of(self, name: str) -> tuple[tuple[Citation, str], ...]:
        """Citation and text of each chunk of a published document."""
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
        """The k best chunks of these `kinds` with at least the trust `min_trust`, best first; ties by document order.

        With `robot`, documents about other robots are left out. At most `per_document` chunks of one document are
        returned, so that one document cannot displace the others.

        Mode "both" fuses the rankings by words and by meaning (see `fuse_scores`). The score is multiplied by the
        factor of the trust level. Raises `ConfigurationError` for a search by meaning without an encoder, or with
        vectors of another encoder.
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
        weighted = {
            number: score * TRUST_WEIGHTS[self._chunks[number].document.trust] for number, score in scores.items()
        }
        best = self._limit_per_document(sorted(weighted, key=lambda number: (-weighted[number], number)), per_document)[
            :k
        ]
        return tuple(self._hit(number, weighted[number], meaning.get(number), words.get(number)) for number in best)

    def _limit_per_document(self, ranked: list[int], per_document: int) -> list[int]:
        """`ranked` with at most `per_document` chunks of each document."""
        count: Counter[str] = Counter()
        kept: list[int] = []
        for number in ranked:
            name = self._chunks[number].document.name
            count[name] += 1
            if count[name] <= per_document:
                kept.append(number)
        return kept

    def _search_words(self, query: str, allowed: set[int]) -> dict[int, float]:
        """BM25 over the words of the query, each of which is optional."""
        words = re.findall(r"\w+", query[:MAX_QUERY_CHARACTERS].lower().replace("_", " "))
        terms = [term for term in dict.fromkeys(words) if term not in STOP_WORDS]
        if not terms:
            return {}
        found = self._store.search_words(" OR ".join(f'"{term}"' for term in terms), len(self._chunks))
        return _truncate_ranking({number: score for number, score in found.items() if number in allowed})

    def _search_embeddings(self, query: str, allowed: set[int]) -> dict[int, float]:
        """Cosine of the query with every chunk, best first."""
        if self._encoder is None:
            raise ConfigurationError.stating(
                "A search by meaning needs a sentence encoder.", fix="Open the library with one, or search by words."
            )
        embedder = self._store.embedder()
        if embedder not in {"", embedder_id(self._encoder)}:
            raise _encoder_mismatch(embedder, self._encoder)
        if not len(self._ids):
            return {}
        cosine = self._rows @ self._encoder.encode([query[:MAX_QUERY_CHARACTERS]])[0]
        order = np.lexsort((self._ids, -cosine))
        return {int(self._ids[row]): float(cosine[row]) for row in order if int(self._ids[row]) in allowed}

    def _hit(self, number: int, score: float, cosine: float | None, bm25_score: float | None) -> ChunkHit:
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
            likeness=cosine,
            bm25_score=bm25_score,
        )

    # --- change -----------------------------------------------------------------------------------------------------

    def add(self, submission: Submission, *, now: float) -> Addition | DocumentRejected:
        """Publish a document at `now` [s, 1970 UTC]; a changed document is a new version.

        Returns a `DocumentRejected` for a document that cannot be added; raises `ConfigurationError` without a suitable
        encoder.
        """
        encoder = self._require_encoder()
        document_text = read_document(submission.data, submission.file)
        if isinstance(document_text, DocumentRejected):
            return document_text
        name = submission.name or _default_name(submission.file)
        if not DOCUMENT_NAME_PATTERN.fullmatch(name):
            return DocumentRejected(
                "name",
                ascii(name[:60])[1:-1],
                f"an identifier, {DOCUMENT_NAME_PATTERN.pattern}",
                "Name it with --name.",
            )
        kind = submission.kind or default_kind(document_text)
        if isinstance(kind, DocumentRejected):
            return kind
        if rejection := check_structure(kind, document_text):
            return rejection
        pieces = self._store.stored_chunks(name, document_text.version) or split_chunks(
            document_text, whole_entries=kind in ("map", "template")
        )
        document = Document(
            name=name,
            version=document_text.version,
            kind=kind,
            trust=submission.trust,
            title=storable_text(submission.title) or _default_title(document_text, name),
            media=document_text.media,
            file=storable_text(Path(submission.file).name),
            added=now,
            source=document_text.source,
            characters=len(document_text.text),
            chunks=len(pieces),
            hidden=document_text.hidden,
            robots=submission.robots,
        )
        change = _classify_addition([one for _, one in self.history(name)], document)
        if change != "unchanged":
            rows = encoder.encode(
                [embedding_text(document.title, one, document_text.text[one.start : one.end]) for one in pieces]
            )
            with self._store.transaction():
                numbers = self._store.store_text(name, document_text, pieces)
                self._store.publish(document, now=now)
                self._store.update_projections(embedder_id(encoder), dict(zip(numbers, rows, strict=True)))
            self._load()
        return Addition(document, change)

    def remove(self, name: str, *, now: float) -> Document:
        """Remove a document at `now` [s, 1970 UTC]; its citations can still be quoted. Raises `UnknownNameError`."""
        encoder = self._require_encoder()
        document = self.document(name)
        with self._store.transaction():
            self._store.withdraw(name, now=now)
            self._store.update_projections(embedder_id(encoder), {})
        self._load()
        return document

    def rebuild(self) -> int:
        """Recompute words and vectors of all published documents with this encoder; returns the number of chunks."""
        if self._encoder is None:
            raise ConfigurationError.stating("A rebuild needs a sentence encoder.", fix="Open the library with one.")
        with self._store.transaction():
            chunks = self._store.chunks()
            texts = [embedding_text(one.document.title, one.chunk, one.text) for one in chunks]
            self._store.clear_projections()
            self._store.update_projections(
                embedder_id(self._encoder),
                dict(zip((one.id for one in chunks), self._encoder.encode(texts), strict=True)),
            )
        self._load()
        return len(self)

    def _require_encoder(self) -> Encoder:
        """The encoder; raises `ConfigurationError` without one, or if the stored vectors are of another one."""
        if self._encoder is None:
            raise ConfigurationError.stating(
                "Changes of the library need a sentence encoder.", fix="Open the library with one."
            )
        embedder = self._store.embedder()
        if embedder not in {"", embedder_id(self._encoder)}:
            raise _encoder_mismatch(embedder, self._encoder)
        return self._encoder

    def close(self) -> None:
        """Close the store."""
        self._store.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, kind: type[BaseException] | None, value: object, trace: TracebackType | None) -> None:
        self.close()


def chunk_citation(stored: StoredChunk) -> Citation:
    """The citation of a chunk."""
    return Citation(
        document=stored.document.name,
        version=stored.document.version,
        start=stored.chunk.start,
        end=stored.chunk.end,
        page=stored.chunk.page,
    )


def embedder_id(encoder: Encoder) -> str:
    """Identity of a vector: the encoder, and the version of the text that it encodes (see `embedding_text`)."""
    return f"{encoder.id}, recipe 1"


def embedding_text(title: str, chunk: Chunk, text: str) -> str:
    """The text of a chunk for the encoder, preceded by its innermost headings or the title, which name the subject.

    Of an entry of a TOML file only descriptions are encoded: poses and contracts are looked up by name.
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
        known = any(one is not None and one.version == document.version for one in history)
        return "restored" if known else "new version"
    labels = [(one.kind, one.trust, one.title, one.robots) for one in (last, document)]
    return "unchanged" if labels[0] == labels[1] else "relabelled"


def _default_name(file: str) -> str:
    return re.sub(r"[^a-z0-9]+", "-", Path(file).stem.lower()).strip("-")[:48]


def _default_title(document_text: DocumentText, name: str) -> str:
    """The first heading, or the title of a map or template document; otherwise the name."""
    pattern = (
        r"^#\s+(.+)$" if document_text.media in {"markdown", "html"} else r"^\s*\"?title\"?\s*[=:]\s*\"([^\"\n]+)\""
    )
    found = re.search(pattern, document_text.text, re.MULTILINE)
    return " ".join((found[1] if found else name).split())[:120]


def _encoder_mismatch(embedder: str, encoder: Encoder) -> ConfigurationError:
    return ConfigurationError(
        "vectors of the knowledge store",
        got=embedder,
        allowed=f"those of {embedder_id(encoder)}",
        fix="Recompute them with `dualbrain knowledge rebuild`.",
    )


SEMANTIC_WEIGHT = 0.7
"""Weight of meaning in the fused score; docs/explanation/knowledge.md describes the measurement."""


def fuse_scores(
    bm25: Mapping[int, float], cosine: Mapping[int, float], semantic_weight: float = SEMANTIC_WEIGHT
) -> dict[int, float]:
    """Fused score (1 − a) bm25(d)/max bm25 + a max(0, cos(d)) of each chunk d, with a = `semantic_weight`.

    The part of the words is relative to the best chunk, the part of the meaning is absolute.
    """
    best = max(bm25.values(), default=0.0)
    return {
        item: (1.0 - semantic_weight) * (bm25.get(item, 0.0) / best if best > 0.0 else 0.0)
        + semantic_weight * max(0.0, cosine.get(item, 0.0))
        for item in {*bm25, *cosine}
    }


def has_site_documents(path: Path) -> bool:
    """Whether the store at `path` has a published document of trust `site`; False without a store.

    Raises the errors of `DocumentStore`.
    """
    if not path.exists():
        return False
    store = DocumentStore(path, write=False)
    try:
        return any(one.trust == "site" for one in store.documents().values())
    finally:
        store.close()
