"""Instructions and other text in a prompt, and documents."""

from __future__ import annotations

import logging
from importlib import import_module
from unittest.mock import patch

import numpy as np

from dualbrain.core.untrusted.bounded_process import DEFAULT_LIMITS, ProcessFailure, ProcessLimits
from dualbrain.core.untrusted.hidden_characters import has_hidden_characters
from dualbrain.errors import DualbrainError
from dualbrain.knowledge.readers import reader
from dualbrain.knowledge.readers.reader import DocumentText, read_document
from dualbrain.knowledge.structured.kinds import check_structure, default_kind
from dualbrain.planner.prompt.sanitize import compact_json, format_block, sanitize
from experiments.interfaces.fuzz_documents import MAX_BYTES, SAMPLES, make_pdf
from experiments.interfaces.untrusted_bytes.interface import ByteInterface, Surprise, refuse_if
from experiments.interfaces.untrusted_bytes.mutation import PLAIN, TOML, VALID, mutate_bytes, mutate_text

INSTRUCTION = "put the red cube that is 0.5 m to the left into the blue bowl, then move 2 steps home"
MAP = b"""kind = "map"
title = "Example room with a table"
frame = "room"
about = "One room of 6 m by 4.5 m."
[[frames]]
name = "table"
position = [2.0, 3.2, 0.75]
yaw = -1.5
about = "Base of the arm on the table top."
[[places]]
name = "spot"
frame = "table"
position = [0.55, 0.28, 0.0]
region = [[0.49, 0.22], [0.61, 0.22], [0.61, 0.34], [0.49, 0.34]]
about = "Free spot on the table."
"""
LIMIT = 300
DOCUMENT_SHARE = 0.05
KEPT_CONTROLS = "\n\t\f"
DOCUMENTS = SAMPLES | {
    "HTML": b"<html><head><style>p.x{color:#333}</style></head><body><h1>Manual of the gripper</h1><p class='x'>Hold a "
    b"glass with at most 10 N.</p><table><tr><td style='font-size:11px'>cube</td></tr></table></body></html>",
    "PDF": make_pdf("BT /F1 12 Tf 72 700 Td (Hold a glass with a force of at most 10 N) Tj ET"),
}
SUFFIXES = {"Markdown": ".md", "HTML": ".html", "PDF": ".pdf"}


def run_in_process(function: str, argument: bytes, limits: ProcessLimits = DEFAULT_LIMITS) -> bytes | ProcessFailure:
    """As `run_bounded`, without a process and its limits; an exception becomes the failure of the process."""
    del limits
    module, _, name = function.partition(":")
    try:
        return getattr(import_module(module), name)(argument)
    except DualbrainError:
        raise
    except (Exception, MemoryError) as error:  # the process would report it
        return ProcessFailure("exception", f"raised {type(error).__name__}")


def text_interfaces() -> dict[str, ByteInterface]:
    """Interfaces by name."""
    logging.getLogger("pypdf").setLevel(logging.CRITICAL)
    found = {
        "instruction": ByteInterface(mutate=_plain(INSTRUCTION.encode()), read=_instruction, refuses=frozenset()),
        "text in JSON of a prompt": ByteInterface(
            mutate=_plain(INSTRUCTION.encode()), read=_prompt_json, refuses=frozenset()
        ),
        "document in a process": ByteInterface(
            mutate=_plain(DOCUMENTS["HTML"]), read=_document(".html", in_process=False), refuses=_NOTHING, share=0.001
        ),
    }
    for name, suffix in SUFFIXES.items():
        found[f"{name} document"] = ByteInterface(
            mutate=_plain(DOCUMENTS[name]),
            read=_document(suffix),
            refuses=_NOTHING,
            share=DOCUMENT_SHARE,
        )
    map_mutator = lambda kind, rng: mutate_text(kind, MAP, TOML, rng)  # noqa: E731
    return found | {"map": ByteInterface(mutate=map_mutator, read=_structured, refuses=_NOTHING, share=0.1)}


_NOTHING = frozenset({"no bytes", "compressed"})


def _plain(data: bytes):
    def mutate(kind: str, rng: np.random.Generator) -> bytes | None:
        return mutate_bytes(kind, data, rng) if kind == VALID else mutate_text(kind, data, PLAIN, rng)

    return mutate


def _instruction(data: bytes) -> None:
    text = data.decode("utf-8", "surrogateescape")
    block = format_block("instruction", text, limit=LIMIT)
    inner = block.removeprefix("<instruction>\n").removesuffix("\n</instruction>")
    _check_line(inner, LIMIT)
    if sanitize(inner, limit=LIMIT) != inner and not inner.endswith("..."):
        raise Surprise("sanitising twice changes the text")


def _check_line(text: str, limit: int) -> None:
    if len(text) > limit or has_hidden_characters(text) or any(mark in text for mark in "<>[]"):
        raise Surprise(f"the prompt contains {text[:60]!r}")


def _prompt_json(data: bytes) -> None:
    text = data.decode("latin-1")
    found = compact_json({"a": [text, {text[:50]: float(len(text))}]}, limit=1000)
    refuse_if(not found, "not within the limit")
    if not found.isascii() or "<" in found or len(found) > 1000:
        raise Surprise(f"the prompt contains {found[:60]!r}")


def _document(suffix: str, *, in_process: bool = True):
    def read(data: bytes) -> None:
        if in_process and len(data) <= MAX_BYTES:
            with patch.object(reader, "run_bounded", run_in_process):
                found = read_document(data, f"a{suffix}")
        else:
            found = read_document(data, f"a{suffix}")
        refuse_if(not isinstance(found, DocumentText), found)
        if has_hidden_characters(found.text, allowed=KEPT_CONTROLS):  # type: ignore[union-attr]
            raise Surprise("the text of the document contains hidden characters")

    return read


def _structured(data: bytes) -> None:
    found = read_document(data, "a.toml")
    refuse_if(not isinstance(found, DocumentText), found)
    refuse_if(check_structure(default_kind(found), found))  # type: ignore[arg-type]
