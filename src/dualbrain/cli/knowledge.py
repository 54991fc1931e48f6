"""dualbrain knowledge: the documents that a planner may be shown: add, list, search, show, remove, rebuild."""

from __future__ import annotations

import sys
import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import msgspec
from cyclopts import Parameter
from rich.console import Console
from rich.markup import escape

from dualbrain.cli.common.console import answer, listing
from dualbrain.cli.common.exit_codes import Exit
from dualbrain.cli.common.paths import cache, home
from dualbrain.errors import WrongUsage
from dualbrain.knowledge.document import KINDS, Document, Kind, Trust, parse_citation
from dualbrain.knowledge.library import Addition, By, Library, Submission
from dualbrain.knowledge.rejection import Refused

Json = Annotated[bool, Parameter(negative="", help="print one JSON object on stdout")]
Store = Annotated[Path | None, Parameter(help="the store; default: knowledge.sqlite in dualbrain's home")]


def add(
    *files: Path, kind: Kind | None = None, trust: Trust = "unknown", name: str = "", title: str = "",
    body: tuple[str, ...] = (), store: Store = None, json: Json = False,
) -> int:  # fmt: skip
    """Put documents on the shelf: Markdown, text, HTML, PDF, or a map or templates in TOML or JSON.

    What a reader would not see (hidden or tiny text, comments, control characters, chat tokens) is left out and told.
    A document that is there already becomes a new version; old citations still resolve. Only documents with trust
    `site` or `vendor` are ever shown to a planner: read a document before you vouch for it.

    Exits 0 if every document was taken, 5 if one was refused.

    Parameters
    ----------
    files
        What to add; the suffix says what it is.
    kind
        `rule`, `manual`, `map` or `template`; default: what a TOML or JSON file says, else manual.
    trust
        `site`: written or approved by who runs this robot; `vendor`: by who made it; `unknown`: can be found, is never
        shown to a planner.
    name
        What to call it, if not after its file; for a single file.
    title
        Its title, if not its first heading.
    body
        The robot it is about; may be given several times; default: it holds for all.
    """
    if not files or (name and len(files) > 1):
        raise WrongUsage("files", got=len(files), allowed="at least one; with --name exactly one")
    done: list[Addition | Refused] = []
    with _library(store, write=True) as library:
        for file in files:
            submission = Submission(file.name, file.read_bytes(), trust, name, kind, title, body)
            one = _unfit(submission) or library.add(submission, now=time.time())
            done.append(one)
            if isinstance(one, Refused):
                _tell(f"{file}: refused: {one}")
            else:
                _tell_addition(one)
    if json:
        answer(msgspec.json.encode({"documents": [_told(one) for one in done]}).decode())
    return Exit.SETUP if any(isinstance(one, Refused) for one in done) else Exit.SUCCESS


def list_documents(*, store: Store = None, json: Json = False) -> int:
    """List what stands on the shelf: name, kind, trust, version, size, title."""
    with _library(store) as library:
        documents = library.documents()
    if json:
        answer(msgspec.json.encode({"documents": documents}).decode())
        return Exit.SUCCESS
    listing(("name", "kind", "trust", "version", "chunks", "hidden", "title"), map(_row, documents), gives=("title",))
    return Exit.SUCCESS


def search(
    query: str, /, *, k: int = 5, by: By = "both", kind: tuple[Kind, ...] = KINDS, trust: Trust = "unknown",
    body: str = "", store: Store = None, json: Json = False,
) -> int:  # fmt: skip
    """Find the passages that answer a question, best first, each with the citation that quotes it again.

    Parameters
    ----------
    query
        A question, or some words.
    k
        How many.
    by
        `words` (BM25), `meaning` (sentence encoder) or `both`, which finds most; `words` needs no model files.
    kind
        Only these kinds; may be given several times.
    trust
        The least trust: `site`, `vendor` or `unknown`.
    body
        Leave out documents about other robots than this one.
    """
    with _library(store, words_only=by == "words") as library:
        hits = library.search(query, k, by=by, kinds=kind, least=trust, body=body)
    if json:
        answer(msgspec.json.encode({"query": query, "hits": [_hit(one) for one in hits]}).decode())
        return Exit.SUCCESS
    console = Console(highlight=False)
    for one in hits:
        parts = (("likeness", one.likeness), ("words", one.words))
        score = ", ".join(f"{part} {value:.2f}" for part, value in parts if value is not None)
        where = " › ".join(dict.fromkeys((one.title, *one.path)))
        console.print(f"[bold]{one.citation}[/]  [dim]{one.kind}, {one.trust}, {score}[/]\n{escape(where)}")
        console.print(f"  {escape(' '.join(one.text.split()))}\n")
    if not hits:
        _tell("nothing found")
    return Exit.SUCCESS


def show(what: str, /, *, version: str = "", store: Store = None, json: Json = False) -> int:
    """Print a document as it is kept, or exactly what a citation quotes; about it on stderr.

    Parameters
    ----------
    what
        A name of `dualbrain knowledge list`, or a citation such as site-rules@b857fcc2256e#479-934.
    version
        An older version of the document (the first digits suffice).
    """
    citation = parse_citation(what)
    with _library(store) as library:
        if citation is not None:
            quoted = library.quote(citation)
            if isinstance(quoted, Refused):
                _tell(str(quoted))
                return Exit.SETUP
            answer(msgspec.json.encode({"citation": what, "text": quoted}).decode() if json else quoted)
            return Exit.SUCCESS
        history, reading = library.history(what), library.reading(what, version)
        if json:
            versions = [{"time": when, "document": one} for when, one in history]
            answer(msgspec.json.encode({"name": what, "versions": versions, "text": reading.text}).decode())
            return Exit.SUCCESS
        for when, one in history:
            _tell(f"{datetime.fromtimestamp(when, UTC):%Y-%m-%d %H:%M} UTC  {_line(one) if one else 'removed'}")
        for hidden in reading.hidden:
            _tell(f"left out: {hidden.characters} characters, {hidden.kind}: {hidden.sample}")
        answer(reading.text)
    return Exit.SUCCESS


def remove(*names: str, store: Store = None, json: Json = False) -> int:
    """Take documents off the shelf. They are found no more; what was cited of them can still be quoted.

    Parameters
    ----------
    names
        Names of `dualbrain knowledge list`.
    """
    if not names:
        raise WrongUsage("names", got="none", allowed="at least one", fix="See `dualbrain knowledge list`.")
    with _library(store, write=True) as library:
        removed = [library.remove(name, now=time.time()) for name in names]
    for one in removed:
        _tell(f"removed {_line(one)}")
    if json:
        answer(msgspec.json.encode({"removed": removed}).decode())
    return Exit.SUCCESS


def rebuild(*, store: Store = None, json: Json = False) -> int:
    """Make the index of words and the vectors again from the documents, for example after a change of the encoder."""
    with Library(_path(store), _encoder(), write=True) as library:
        count = library.rebuild()
    _tell(f"{count} chunks indexed")
    if json:
        answer(msgspec.json.encode({"chunks": count}).decode())
    return Exit.SUCCESS


def _library(store: Path | None, *, write: bool = False, words_only: bool = False) -> Library:
    """The library, with dualbrain's own documents; a new one is made with them."""
    from dualbrain.knowledge.builtin_documents import open_library

    path = _path(store)
    if words_only and path.exists():
        return Library(path, None)
    if not write:
        return open_library(path, _encoder(), now=time.time())
    open_library(path, encoder := _encoder(), now=time.time()).close()
    return Library(path, encoder, write=True)


def _path(store: Path | None) -> Path:
    return store or home() / "knowledge.sqlite"


def _encoder() -> Any:
    from dualbrain.memory.embedding.text_encoder import MiniLmEncoder

    return MiniLmEncoder.fetched(cache())


def _unfit(submission: Submission) -> Refused | None:
    """Why templates cannot be used: the gate would refuse a contract made from one."""
    from dualbrain.grounding.document_retrieval import unfit_templates

    return unfit_templates(submission)


def _tell_addition(done: Addition) -> None:
    _tell(f"{done.change}: {_line(done.document)}")
    for hidden in done.document.hidden:
        _tell(f"  left out: {hidden.characters} characters, {hidden.kind}: {hidden.sample}")
    if done.document.trust == "unknown":
        _tell("  trust unknown: it can be found, but no planner is shown it. Add it again with --trust site or vendor.")


def _row(one: Document) -> tuple[str, ...]:
    hidden = str(sum(part.characters for part in one.hidden) or "")
    return (one.name, one.kind, one.trust, one.version[:12], str(one.chunks), hidden, one.title)


def _line(one: Document) -> str:
    return f"{one.name} ({one.kind}, {one.trust}, {one.chunks} chunks, version {one.version[:12]}): {one.title}"


def _told(one: Addition | Refused) -> dict[str, Any]:
    if isinstance(one, Refused):
        return {"refused": one}
    return {"change": one.change, "document": one.document}


def _hit(one: Any) -> dict[str, Any]:
    return {**msgspec.to_builtins(one), "citation": str(one.citation), "version": one.citation.version}


def _tell(text: str) -> None:
    print(text, file=sys.stderr)
