"""The library: versions, removal, trust, concurrent and killed writers, other encoders, damaged files."""

import os
import shutil
import signal
import sqlite3
import subprocess
import sys
import threading
import time
from pathlib import Path

import msgspec
import pytest

from dualbrain.errors import ConfigurationError, MissingDependencyError, UnknownNameError
from dualbrain.knowledge import store
from dualbrain.knowledge.builtin_documents import BUILTIN_DOCUMENTS, add_builtin_documents
from dualbrain.knowledge.document import Citation
from dualbrain.knowledge.library import Addition, Library, Submission
from dualbrain.knowledge.rejection import CorruptStoreError, DocumentRejected, StoreInUseError
from dualbrain.memory.embedding.hashing_encoder import HashingEncoder
from tests.knowledge.pdf_builder import make_pdf, show_text

NOTE = "# Note on cups\n\nCups are lifted with both fingers and little force, never by the handle.\n"
OTHER = "# Note on cups\n\nCups may be lifted by the handle if it is strong enough to bear them.\n"


def put(library: Library, text: str = NOTE, **changed: object) -> Addition:
    fields: dict[str, object] = {"file": "cups.md", "data": text.encode(), "trust": "site"}
    done = library.add(Submission(**(fields | changed)), now=1.0)  # pyright: ignore[reportArgumentType]
    assert isinstance(done, Addition), done
    return done


def test_an_added_document_is_found_and_quoted(library: Library) -> None:
    done = put(library)
    assert (done.change, done.document.title, done.document.kind) == ("new", "Note on cups", "manual")
    for by in ("both", "words", "meaning"):
        hit = library.search("how are cups lifted", mode=by)[0]
        assert library.quote(hit.citation) == hit.text
        assert "both fingers" in hit.text
    assert put(library).change == "unchanged"
    assert len(library.history("cups")) == 1


def test_a_changed_document_is_a_new_version_and_old_citations_still_resolve(library: Library) -> None:
    old = library.search("cups", 1) or (put(library) and library.search("cups", 1))
    done = put(library, OTHER)
    assert done.change == "new version"
    assert [hit.text for hit in library.search("cups")] == [OTHER.split("\n\n")[1].strip()]
    assert library.quote(old[0].citation) == old[0].text == NOTE.split("\n\n")[1].strip()
    assert put(library).change == "restored"
    assert library.search("cups")[0].text == old[0].text
    assert [one.version for _, one in library.history("cups") if one] == [
        old[0].citation.version,
        done.document.version,
        old[0].citation.version,
    ]


def test_a_removed_document_is_not_found_but_can_be_quoted(library: Library) -> None:
    put(library)
    cited = library.search("cups")[0]
    library.remove("cups", now=2.0)
    assert (library.documents(), library.search("cups"), len(library)) == ((), (), 0)
    assert library.quote(cited.citation) == cited.text
    with pytest.raises(UnknownNameError):
        library.remove("cups", now=3.0)
    assert put(library).change == "restored"


def test_a_reopened_store_gives_the_same_results(library: Library, tmp_path: Path) -> None:
    put(library)
    put(library, "# Plates\n\nPlates are stacked by size, the largest one below all others.\n", file="plates.md")
    put(library, OTHER)
    expected = library.search("cups and plates", 9)
    with Library(tmp_path / "knowledge.sqlite", HashingEncoder(64)) as again:
        assert again.search("cups and plates", 9) == expected
        assert again.documents() == library.documents()


def test_trust_filters_and_ranks_documents(library: Library) -> None:
    put(library)
    done = library.add(Submission(file="blog.md", data=OTHER.encode()), now=1.0)
    assert isinstance(done, Addition)
    assert done.document.trust == "unknown"
    assert {hit.trust for hit in library.search("cups handle")} == {"site", "unknown"}
    assert {hit.trust for hit in library.search("cups handle", min_trust="vendor")} == {"site"}
    best = library.search("cups lifted", 1)[0]
    twin = put(library, NOTE, file="twin.md", trust="unknown")
    assert library.search("cups lifted", 1)[0].citation == best.citation
    assert put(library, NOTE, file="twin.md", trust="site").change == "relabelled"
    assert twin.document.version == library.document("twin").version


@pytest.mark.parametrize(
    "changed",
    [
        {"file": "Über größe!!.md", "name": "../x"},
        {"file": "x.docx"},
        {"kind": "map"},
        {"file": "m.toml", "kind": "template"},
    ],
)
def test_an_invalid_submission_is_rejected_and_not_stored(library: Library, changed: dict[str, str]) -> None:
    fields = {"file": "cups.md", "data": NOTE.encode()} | changed
    assert isinstance(library.add(Submission(**fields), now=1.0), DocumentRejected)  # pyright: ignore[reportArgumentType]
    assert library.documents() == ()


@pytest.mark.parametrize(
    ("file", "text"),
    [
        ("hall.toml", 'kind = "map"\ntitle = "Hall of the base"\nframe = "start"\n\n[[places]\nname = "gate"\n'),
        ("hall.toml", 'kind = "maps"\ntitle = "Hall of the base"\nframe = "start"\n'),
        ("hall.json", '{"kind": "map", "title": "Hall of the base", "frame": "start",}'),
    ],
)
def test_a_map_with_a_mistake_does_not_become_a_manual(library: Library, file: str, text: str) -> None:
    rejection = library.add(Submission(file=file, data=text.encode(), trust="site"), now=1.0)
    assert isinstance(rejection, DocumentRejected)
    assert "--kind" in rejection.fix
    assert library.documents() == ()
    assert put(library, text, file=file, kind="manual").document.kind == "manual"
    assert put(library, '["a list of rules", "that declares no kind"]', file="list.json").document.kind == "manual"


def test_a_citation_without_a_target_is_rejected(library: Library) -> None:
    version = put(library).document.version
    for citation in (
        Citation(document="cups", version="0" * 64, start=0, end=5),
        Citation(document="mugs", version=version, start=0, end=5),
        Citation(document="cups", version=version, start=0, end=10**6),
        Citation(document="cups", version=version, start=-3, end=5),
    ):
        assert isinstance(library.quote(citation), DocumentRejected)


def test_a_citation_with_another_page_is_rejected(library: Library) -> None:
    version = put(library).document.version
    plain = Citation(document="cups", version=version, start=0, end=5)
    assert isinstance(library.quote(plain), str)
    rejected = library.quote(msgspec.structs.replace(plain, page=7))
    assert isinstance(rejected, DocumentRejected)
    assert "the document has none" in rejected.allowed
    data = make_pdf(show_text("one short page of words"), show_text("and a second one of them"))
    added = library.add(Submission(file="pages.pdf", data=data), now=1.0)
    assert not isinstance(added, DocumentRejected)
    for page, (citation, text) in enumerate(library.chunks_of("pages"), start=1):
        assert citation.page == page
        assert library.quote(citation) == library.quote(msgspec.structs.replace(citation, page=None)) == text
        assert isinstance(library.quote(msgspec.structs.replace(citation, page=3 - page)), DocumentRejected)


@pytest.mark.parametrize(
    "query",
    ["", "   ", '"', "NEAR(", "a AND", "col:x", "*", "x" * 50_000, "\0", "💥", "'; DROP TABLE reading; --", "OR"],
)
def test_any_query_is_accepted(library: Library, query: str) -> None:
    put(library)
    for by in ("both", "words", "meaning"):
        assert len(library.search(query, mode=by)) <= 5


def test_another_encoder_is_refused_until_the_vectors_are_rebuilt(library: Library, tmp_path: Path) -> None:
    put(library)
    path = tmp_path / "knowledge.sqlite"
    with pytest.raises(ConfigurationError, match="knowledge rebuild"):
        Library(path, HashingEncoder(32))
    with Library(path, HashingEncoder(32), write=True) as other:
        with pytest.raises(ConfigurationError, match="knowledge rebuild"):
            other.search("cups")
        with pytest.raises(ConfigurationError, match="knowledge rebuild"):
            put(other, OTHER)
        assert other.search("cups", mode="words")
        assert other.rebuild() == 1
        assert other.search("cups", mode="meaning")
    with Library(path, None) as words_only:
        assert words_only.search("cups", mode="words")
        with pytest.raises(ConfigurationError, match="encoder"):
            words_only.search("cups")


def test_rebuilt_projections_are_the_same(library: Library) -> None:
    put(library)
    put(library, "# Plates\n\nPlates are stacked by size, the largest one below all others.\n", file="plates.md")
    before = {by: library.search("cups and plates", 9, mode=by) for by in ("both", "words", "meaning")}
    library.rebuild()
    assert {by: library.search("cups and plates", 9, mode=by) for by in ("both", "words", "meaning")} == before


def test_a_new_title_is_found_instead_of_the_old_one(library: Library) -> None:
    put(library, title="Crockery")
    assert library.search("crockery", mode="words")
    assert put(library, title="Tableware").change == "relabelled"
    found = {word: library.search(word, mode="words") for word in ("crockery", "tableware", "fingers")}
    assert [len(hits) for hits in found.values()] == [0, 1, 1]
    library.rebuild()
    assert {word: library.search(word, mode="words") for word in found} == found


def test_a_file_name_that_is_not_utf8_is_stored_readably(library: Library) -> None:
    done = put(library, file=os.fsdecode(b"Regeln f\xfcr Tassen.md"), title=os.fsdecode(b"f\xfcr"))
    assert (done.document.name, done.document.file) == ("regeln-f-r-tassen", "Regeln f\ufffdr Tassen.md")
    assert done.document.title == "f\ufffdr"
    assert (
        put(library, file=os.fsdecode(b"Regeln f\xfcr Tassen.md"), title=os.fsdecode(b"f\xfcr")).change == "unchanged"
    )


def test_history_cannot_be_changed(library: Library, tmp_path: Path) -> None:
    put(library)
    other = sqlite3.connect(tmp_path / "knowledge.sqlite")
    for statement in (
        "DELETE FROM event",
        "UPDATE reading SET data = x''",
        "DELETE FROM chunk",
        "UPDATE chunk SET start = 0",
    ):
        with pytest.raises(sqlite3.IntegrityError, match="append-only"):
            other.execute(statement)
    other.close()


def test_a_second_writer_waits_and_is_refused(
    library: Library, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(store, "LOCK_TIMEOUT_S", 0.1)
    path = tmp_path / "knowledge.sqlite"
    with Library(path, HashingEncoder(64), write=True) as second:
        blocker = sqlite3.connect(path, isolation_level=None, check_same_thread=False)
        blocker.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreInUseError, match="Another process"):
            put(second)
        with Library(path, HashingEncoder(64)) as reader:
            assert reader.documents() == ()
        timer = threading.Timer(0.02, lambda: blocker.execute("ROLLBACK"))
        timer.start()
        timer.join()
        assert put(second).change == "new"
        blocker.close()


def test_writers_of_several_processes_lose_nothing(tmp_path: Path) -> None:
    code = (
        "import sys; from pathlib import Path; from dualbrain.knowledge.library import *; "
        "from dualbrain.memory.embedding.hashing_encoder import HashingEncoder\n"
        "with Library(Path(sys.argv[1]), HashingEncoder(16), write=True) as l:\n"
        "  for n in range(8):\n"
        "    text = f'# D{n}\\n\\nwords of {sys.argv[2]} that are its own {n}'\n"
        "    l.add(Submission(file=f'{sys.argv[2]}-{n}.md', data=text.encode()), now=1.0)\n"
    )
    path = tmp_path / "k.sqlite"
    writers = [
        subprocess.Popen([sys.executable, *(["-S"] if sys.flags.no_site else []), "-c", code, str(path), name])
        for name in "ab"
    ]
    assert [one.wait(60) for one in writers] == [0, 0]
    with Library(path, HashingEncoder(16)) as library:
        assert len(library.documents()) == 16
        assert len(library.search("words", 50, mode="meaning")) == 16


def test_a_killed_writer_loses_nothing_it_acknowledged(tmp_path: Path) -> None:
    path = tmp_path / "k.sqlite"
    script = Path(__file__).with_name("crash_writer.py")
    for attempt in range(4):
        command = [sys.executable, *(["-S"] if sys.flags.no_site else []), str(script), str(path)]
        adder = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, cwd=Path.cwd())
        assert adder.stdout is not None
        acknowledged = [adder.stdout.readline() for _ in range(3 + attempt)]
        time.sleep(0.003 * attempt)
        os.kill(adder.pid, signal.SIGKILL)
        acknowledged += adder.stdout.readlines()
        adder.wait()
        adder.stdout.close()
        last = int([line for line in acknowledged if line.endswith("\n")][-1])
        with Library(path, HashingEncoder(16)) as library:
            name = f"d{last % 7}"
            assert any(f"Document {last}" in one.title for _, one in library.history(name) if one)
            for document in library.documents():
                assert library.search(document.title, 9, mode="words")
                for citation, text in library.chunks_of(document.name):
                    assert library.quote(citation) == text
            assert len(library.search("anything", 99, mode="meaning")) == len(library)


def test_a_reader_rolls_back_the_unfinished_transaction_of_a_killed_writer(library: Library, tmp_path: Path) -> None:
    put(library)
    original, killed = tmp_path / "knowledge.sqlite", tmp_path / "killed.sqlite"
    writer = sqlite3.connect(original, isolation_level=None)
    writer.execute("PRAGMA cache_size = 1")  # so that pages reach the file before the transaction ends
    writer.execute("BEGIN IMMEDIATE")
    writer.execute("CREATE TABLE half (done)")
    for _ in range(200):
        writer.execute("INSERT INTO half VALUES (randomblob(4000))")
    for end in ("", "-journal"):
        shutil.copyfile(f"{original}{end}", f"{killed}{end}")
    writer.execute("ROLLBACK")
    assert killed.stat().st_size > original.stat().st_size
    with Library(killed, None) as again:
        assert again.documents() == library.documents()
    assert killed.stat().st_size == original.stat().st_size


def test_a_file_that_is_not_a_store_is_reported(tmp_path: Path) -> None:
    with pytest.raises(MissingDependencyError, match="knowledge add"):
        Library(tmp_path / "none.sqlite", None)
    noise = tmp_path / "noise.sqlite"
    noise.write_bytes(b"this is no database at all, " * 100)
    foreign = tmp_path / "foreign.sqlite"
    sqlite3.connect(foreign).execute("CREATE TABLE t (x)").connection.close()
    for path in (noise, foreign):
        for write in (False, True):
            with pytest.raises(CorruptStoreError, match=path.name):
                Library(path, None, write=write)


def test_a_store_with_a_newer_schema_is_refused(library: Library, tmp_path: Path) -> None:
    other = sqlite3.connect(tmp_path / "knowledge.sqlite")
    other.execute("UPDATE meta SET value = '99' WHERE key = 'schema_version'").connection.commit()
    other.close()
    with pytest.raises(ConfigurationError, match="schema_version"):
        Library(tmp_path / "knowledge.sqlite", None)


def test_a_store_on_a_read_only_disk_can_be_read(library: Library, tmp_path: Path) -> None:
    put(library)
    library.close()
    path = tmp_path / "knowledge.sqlite"
    assert [file.name for file in tmp_path.iterdir()] == [path.name]  # a single file when no process writes it
    path.chmod(0o444)
    tmp_path.chmod(0o555)
    try:
        with Library(path, HashingEncoder(64)) as reader:
            assert reader.search("cups")
    finally:
        tmp_path.chmod(0o755)


def test_builtin_documents_are_added_once_and_stay_removed(library: Library) -> None:
    assert len(add_builtin_documents(library, now=1.0)) == len(BUILTIN_DOCUMENTS)
    assert add_builtin_documents(library, now=2.0) == ()
    library.remove("ur5e-notes", now=3.0)
    own = put(
        library,
        "# Our rules\n\nOn this site nothing is lifted above shoulder height by a robot.\n",
        file="site-rules.md",
        kind="rule",
    )
    assert add_builtin_documents(library, now=4.0) == ()
    assert library.document("site-rules").version == own.document.version
    assert "ur5e-notes" not in {one.name for one in library.documents()}
