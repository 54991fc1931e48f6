"""dualbrain knowledge: manage the documents that a planner may read."""

from __future__ import annotations

import time
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any

import msgspec
from cyclopts import Parameter
from rich.markup import escape

from dualbrain.cli.common.console import StderrConsole, VisibleConsole, print_message, print_result, print_table
from dualbrain.cli.common.exit_codes import ExitCode
from dualbrain.cli.common.spinner import Spinner
from dualbrain.core.paths import cache_folder, dualbrain_home
from dualbrain.core.text import count_noun
from dualbrain.core.untrusted.bounded_file import FileRefusal, byte_size, read_regular_file
from dualbrain.errors import ConfigurationError, UsageError
from dualbrain.knowledge.document import DOCUMENT_KINDS, ChunkHit, Document, DocumentKind, TrustLevel, parse_citation
from dualbrain.knowledge.library import Addition, Library, SearchMode, Submission
from dualbrain.knowledge.readers.reader import MAX_FILE_BYTES
from dualbrain.knowledge.rejection import DocumentRejected

Json = Annotated[bool, Parameter(negative="", help="Print one JSON object on stdout.")]
Store = Annotated[
    Path | None, Parameter(help="Document store. Default: knowledge.sqlite in the data folder of dualbrain.")
]


def add(
    *files: Path,
    kind: DocumentKind | None = None,
    trust: TrustLevel = "unknown",
    name: str = "",
    title: str = "",
    robot: tuple[str, ...] = (),
    store: Store = None,
    json: Json = False,
) -> int:
    """Add documents: Markdown, text, HTML, PDF, or a map or templates in TOML or JSON.

    Text that a reader would not see (hidden or tiny text, comments, control characters, chat tokens) is removed and
    reported, and so is a passage that is too long for a prompt. A document with a known name becomes a new version; old
    citations still resolve. Only documents with trust `site` or `vendor` are put into prompts: read a document before
    you declare its trust.

    Exit code 0 if every document was added, 5 if one was rejected.

    Parameters
    ----------
    files
        Files to add; the suffix determines the format.
    kind
        `rule`, `manual`, `map` or `template`. Default: as stated in a TOML or JSON file, else manual.
    trust
        `site`: written or approved by the operator of this robot; `vendor`: by its manufacturer; `unknown`: can be
        searched, but is never put into a prompt.
    name
        Name of the document, for a single file. Default: the file name.
    title
        Title. Default: the first heading.
    robot
        Robot that the document is about (a name, or the folder of its model); may be repeated. Default: all robots.
    """
    if not files or (name and len(files) > 1):
        raise UsageError("files", got=len(files), allowed="at least one; with --name exactly one")
    for file in files:
        if not file.exists():
            raise ConfigurationError.stating(f"There is no file {file}.", fix="Check the path of the document.")
    robot = tuple(map(_robot_name, robot))
    done: list[dict[str, Any]] = []
    with _open_library(store, write=True) as library:
        for file in files:
            data = _read_file(file)
            if isinstance(data, DocumentRejected):
                one = data
            else:
                submission = Submission(
                    file=file.name, data=data, trust=trust, name=name, kind=kind, title=title, robots=robot
                )
                one = _unusable_templates(submission) or library.add(submission, now=time.time())
            if isinstance(one, DocumentRejected):
                print_message(f"{file}: rejected: {one}")
                done.append({"refused": one})
            else:
                unshown = _unshown_passages(library, one.document)
                _print_addition(one, unshown)
                done.append({"change": one.change, "document": one.document, "unshown": unshown})
    if json:
        print_result(msgspec.json.encode({"documents": done}).decode())
    return ExitCode.SETUP if any("refused" in one for one in done) else ExitCode.SUCCESS


def list_documents(*, store: Store = None, json: Json = False) -> int:
    """List the documents: name, kind, trust, version, size, title."""
    with _open_library(store) as library:
        documents = library.documents()
    if json:
        print_result(msgspec.json.encode({"documents": documents}).decode())
        return ExitCode.SUCCESS
    print_table(
        ("name", "kind", "trust", "version", "chunks", "hidden", "title"),
        map(_document_row, documents),
        wrap_columns=("title",),
    )
    return ExitCode.SUCCESS


def search(
    query: str,
    /,
    *,
    k: int = 5,
    by: SearchMode = "both",
    kind: tuple[DocumentKind, ...] = DOCUMENT_KINDS,
    trust: TrustLevel = "unknown",
    robot: str = "",
    store: Store = None,
    json: Json = False,
) -> int:
    """Search passages that answer a question, best first, each with the citation that quotes it.

    Parameters
    ----------
    query
        A question or keywords.
    k
        Number of passages.
    by
        `words` (BM25), `meaning` (sentence encoder) or `both` (best recall); `words` needs no model files.
    kind
        Only documents of these kinds; may be repeated.
    trust
        Minimum trust: `site`, `vendor` or `unknown`.
    robot
        Exclude documents about other robots than this one.
    """
    if k < 1:
        raise UsageError("--k", got=k, allowed="at least 1")
    with _open_library(store, words_only=by == "words") as library:
        if robot and robot not in {name for one in library.documents() for name in one.robots}:
            robot = _robot_name(robot)
        hits = library.search(query, k, mode=by, kinds=kind, min_trust=trust, robot=robot)
    if json:
        print_result(msgspec.json.encode({"query": query, "hits": [_encode_hit(one) for one in hits]}).decode())
        return ExitCode.SUCCESS
    console = VisibleConsole(highlight=False)
    for one in hits:
        parts = (("similarity", one.likeness), ("words", one.bm25_score))
        score = ", ".join(f"{part} {value:.2f}" for part, value in parts if value is not None)
        where = " › ".join(dict.fromkeys((one.title, *one.path)))
        console.print(
            f"[bold]{escape(str(one.citation))}[/]  [dim]{one.kind}, {one.trust}, {score}[/]\n{escape(where)}"
        )
        console.print(f"  {escape(' '.join(one.text.split()))}\n")
    if not hits:
        print_message("nothing found")
    return ExitCode.SUCCESS


def show(what: str, /, *, version: str = "", store: Store = None, json: Json = False) -> int:
    """Print a stored document, or the exact text of a citation; its history on stderr.

    Parameters
    ----------
    what
        A name from `dualbrain knowledge list`, or a citation such as site-rules@b857fcc2256e#479-934.
    version
        An older version of the document (the first digits are sufficient).
    """
    citation = parse_citation(what)
    with _open_library(store) as library:
        if citation is not None:
            quoted = library.quote(citation)
            if isinstance(quoted, DocumentRejected):
                print_message(str(quoted))
                return ExitCode.SETUP
            print_result(msgspec.json.encode({"citation": what, "text": quoted}).decode() if json else quoted)
            return ExitCode.SUCCESS
        history, reading = library.history(what), library.document_text(what, version)
        if json:
            versions = [{"time": when, "document": one} for when, one in history]
            print_result(msgspec.json.encode({"name": what, "versions": versions, "text": reading.text}).decode())
            return ExitCode.SUCCESS
        for when, one in history:
            change = _describe_document(one) if one else "removed"
            print_message(f"{datetime.fromtimestamp(when, UTC):%Y-%m-%d %H:%M} UTC  {change}")
        for hidden in reading.hidden:
            print_message(f"removed: {hidden.characters} characters, {hidden.kind}: {hidden.sample}")
        print_result(reading.text)
    return ExitCode.SUCCESS


def remove(*names: str, store: Store = None, json: Json = False) -> int:
    """Remove documents from the search. Their citations can still be quoted.

    Parameters
    ----------
    names
        Names from `dualbrain knowledge list`.
    """
    if not names:
        raise UsageError("names", got="none", allowed="at least one", fix="See `dualbrain knowledge list`.")
    with _open_library(store, write=True) as library:
        removed = [library.remove(name, now=time.time()) for name in names]
    for one in removed:
        print_message(f"removed {_describe_document(one)}")
    if json:
        print_result(msgspec.json.encode({"removed": removed}).decode())
    return ExitCode.SUCCESS


def rebuild(*, store: Store = None, json: Json = False) -> int:
    """Rebuild the index of words and vectors from the documents, for example after a change of the encoder."""
    spinner = Spinner(StderrConsole(), "rebuilding the index")
    with spinner, Library(_store_path(store), _encoder(), write=True) as library:
        count = library.rebuild()
    print_message(f"{count_noun(count, 'chunk')} indexed")
    if json:
        print_result(msgspec.json.encode({"chunks": count}).decode())
    return ExitCode.SUCCESS


def _open_library(store: Path | None, *, write: bool = False, words_only: bool = False) -> Library:
    """The library; a new one is created with the built-in documents."""
    from dualbrain.knowledge.builtin_documents import open_library

    path = _store_path(store)
    if words_only and path.exists():
        return Library(path, None)
    if not write:
        return open_library(path, _encoder(), now=time.time())
    open_library(path, encoder := _encoder(), now=time.time()).close()
    return Library(path, encoder, write=True)


def _store_path(store: Path | None) -> Path:
    return store or dualbrain_home() / "knowledge.sqlite"


def _robot_name(robot: str) -> str:
    """The name of the robot model that `robot` names; raises `UnknownNameError` and `ConfigurationError`."""
    from dualbrain.robots.loader import load_robot

    return load_robot(robot).name


def _encoder() -> Any:
    from dualbrain.memory.embedding.text_encoder import MiniLmEncoder

    return MiniLmEncoder.from_cache(cache_folder())


def _read_file(file: Path) -> bytes | DocumentRejected:
    """The bytes of a document; a file that is not regular or too large is a rejection, as a wrong format is."""
    data = read_regular_file(file, MAX_FILE_BYTES)
    if isinstance(data, FileRefusal):
        allowed = f"a regular file of at most {byte_size(MAX_FILE_BYTES)}"
        return DocumentRejected("a file that cannot be used", data.sentence.rstrip("."), allowed, data.fix)
    return data


def _unusable_templates(submission: Submission) -> DocumentRejected | None:
    """The rejection of templates whose contracts the gate would reject; None if they are usable."""
    from dualbrain.grounding.document_retrieval import check_templates

    return check_templates(submission)


def _unshown_passages(library: Library, document: Document) -> tuple[str, ...]:
    """The passages of `document` that no planner can get, each with the reason."""
    from dualbrain.grounding.document_retrieval import unshown_passages

    return unshown_passages(library, document) if document.trust != "unknown" else ()


def _print_addition(done: Addition, unshown: tuple[str, ...]) -> None:
    print_message(f"{done.change}: {_describe_document(done.document)}")
    for hidden in done.document.hidden:
        print_message(f"  removed: {hidden.characters} characters, {hidden.kind}: {hidden.sample}")
    for passage in unshown:
        print_message(f"  never put into a prompt: {passage}")
    if unshown:
        print_message("  Shorten such an entry or template, or split it, and add the document again.")
    if done.document.trust == "unknown":
        print_message(
            "  trust unknown: the document can be searched, but is not put into prompts. "
            "Add it again with --trust site or vendor."
        )


def _document_row(one: Document) -> tuple[str, ...]:
    hidden = str(sum(part.characters for part in one.hidden) or "")
    return (one.name, one.kind, one.trust, one.version[:12], str(one.chunks), hidden, one.title)


def _describe_document(one: Document) -> str:
    chunks = count_noun(one.chunks, "chunk")
    return f"{one.name} ({one.kind}, {one.trust}, {chunks}, version {one.version[:12]}): {one.title}"


def _encode_hit(one: ChunkHit) -> dict[str, Any]:
    return {**msgspec.to_builtins(one), "citation": str(one.citation), "version": one.citation.version}
