"""Chunks: exact offsets, pages and headings, and no text is lost or repeated."""

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from dualbrain.knowledge.builtin_documents import BUILTIN_DOCUMENTS, DATA_FOLDER
from dualbrain.knowledge.chunking import MAX_CHUNK_CHARACTERS, split_chunks
from dualbrain.knowledge.document import Citation, parse_citation
from dualbrain.knowledge.library import Library
from dualbrain.knowledge.readers.reader import DocumentText, read_document
from tests.knowledge.pdf_builder import make_pdf, show_text

words = st.lists(
    st.sampled_from(
        ["alpha", "beta.", "gamma\n", "\n\n", "# H\n", "- x\n", "## K\n\n", "ü" * 30, "a" * 700, "| t |\n"]
    ),
    min_size=4,
    max_size=60,
)


def document_text(text: str, name: str = "a.md") -> DocumentText:
    found = read_document((text + "\n\nenough words to be a document at all\n").encode(), name)
    assert isinstance(found, DocumentText)
    return found


@settings(max_examples=80, deadline=None)
@given(words.map(" ".join), st.sampled_from(["a.md", "a.txt"]))
def test_chunks_are_slices_in_order_that_lose_only_headings(text: str, name: str) -> None:
    found = document_text(text, name)
    pieces = split_chunks(found)
    end = 0
    between = ""
    for piece in pieces:
        assert end <= piece.start < piece.end <= len(found.text)
        quoted = found.text[piece.start : piece.end]
        assert quoted == quoted.strip()
        assert len(quoted) <= MAX_CHUNK_CHARACTERS
        between += found.text[end : piece.start]
        end = piece.end
    between += found.text[end:]
    lost = [line.strip() for line in between.splitlines() if line.strip()]
    assert not lost or (name == "a.md" and all(line.startswith("#") for line in lost))


def test_a_chunk_has_the_headings_above_it() -> None:
    found = document_text("# Top\n\nfirst words\n\n## Inner\n\nsecond words\n\n# Other\n\nthird words")
    paths = {found.text[c.start : c.end].split()[0]: c.path for c in split_chunks(found)}
    assert paths == {"first": ("Top",), "second": ("Top", "Inner"), "third": ("Other",)}


def test_no_chunk_crosses_a_page() -> None:
    found = read_document(
        make_pdf(show_text("one short page of words"), show_text("and a second one of them")), "a.pdf"
    )
    assert isinstance(found, DocumentText)
    assert [piece.page for piece in split_chunks(found)] == [1, 2]


def test_an_entry_of_a_toml_file_is_one_chunk() -> None:
    data = (DATA_FOLDER / "panda-templates.toml").read_bytes()
    found = read_document(data, "panda-templates.toml")
    assert isinstance(found, DocumentText)
    named = [piece for piece in split_chunks(found) if found.text[piece.start :].startswith("[[")]
    assert [piece.path[0] for piece in named][:2] == ["fetch_and_place", "fetch_past_a_person"]
    assert len(named) == data.count(b"[[templates]]")


def test_a_long_entry_of_a_toml_file_can_be_split() -> None:
    text = '[[rules]]\nname = "long"\nlines = [\n' + "".join(f'  "rule number {k}",\n' for k in range(60)) + "]\n"
    found = read_document(text.encode(), "rules.toml")
    assert isinstance(found, DocumentText)
    assert len(split_chunks(found)) == 1
    pieces = split_chunks(found, whole_entries=False)
    assert all(piece.end - piece.start <= MAX_CHUNK_CHARACTERS and piece.path == ("long",) for piece in pieces)
    assert " ".join(found.text[one.start : one.end] for one in pieces).split() == text.split()


def test_quoting_a_citation_gives_the_chunk(builtin_library: Library) -> None:
    count = 0
    for document in builtin_library.documents():
        for citation, text in builtin_library.chunks_of(document.name):
            again = parse_citation(str(citation))
            assert again is not None
            assert builtin_library.quote(again) == text
            count += 1
    assert count == len(builtin_library) > 60


@pytest.mark.parametrize("file", [file for file in BUILTIN_DOCUMENTS if file.endswith(".md")])
def test_offsets_of_markdown_are_those_of_the_file(builtin_library: Library, file: str) -> None:
    source = (DATA_FOLDER / file).read_text("utf-8")
    for citation, text in builtin_library.chunks_of(file.removesuffix(".md")):
        assert source[citation.start : citation.end] == text


@settings(deadline=None)
@given(
    st.builds(
        Citation,
        document=st.from_regex(r"[a-z0-9][a-z0-9_-]{0,47}", fullmatch=True),
        version=st.from_regex(r"[0-9a-f]{64}", fullmatch=True),
        start=st.integers(0, 10**8),
        end=st.just(10**9 - 1),
        page=st.none() | st.integers(1, 10**6 - 1),
    )
)
def test_a_citation_survives_its_text_form(citation: Citation) -> None:
    again = parse_citation(str(citation))
    assert again is not None
    assert str(again) == str(citation)
    assert citation.version.startswith(again.version)


@pytest.mark.parametrize(
    "text",
    ["", "a", "a@b#1-2", "a@0123456789ab#2-1", "A@0123456789ab#1-2", "a@0123456789ab#1-2,p", "../x@0123456789ab#1-2"],
)
def test_an_invalid_citation_is_none(text: str) -> None:
    assert parse_citation(text) is None
