"""Text that a reader would not see, and marks by which a document could speak as somebody else, become blanks.

Law: blanking keeps the length, so an offset into the blanked text is an offset into the text it was made from. It is
idempotent, and what it leaves holds no control character but line feed and tab, no character of a format class
(zero-width, direction, tags), no lone surrogate, and no token of a chat template.
"""

from __future__ import annotations

import re
import unicodedata
from collections.abc import Iterable, Sequence

import msgspec

Span = tuple[int, int]

MAX_SAMPLE_CHARACTERS = 80
_PASSES = 4
"""Tokens may be nested so that blanking one makes another; whoever nests deeper loses every bracket."""

_INVISIBLE_CATEGORIES = frozenset({"Cc", "Cf", "Co", "Cs", "Cn", "Zl", "Zp"})
_ALLOWED_CONTROLS = "\n\t"
_FILLERS = frozenset("\u034f\u115f\u1160\u17b4\u17b5\u180b\u180c\u180d\u180f\u2800\u3164\uffa0")
_VARIATION_SELECTORS = (range(0xFE00, 0xFE10), range(0xE0100, 0xE01F0))
_CHAT_TOKENS = re.compile(
    r"<[|\uff5c][^<>\n]{0,60}[|\uff5c]>"  # <|im_start|>, <|start_header_id|>, and with full-width bars
    r"|</?s>|\[/?(?:INST|SYS|AVAILABLE_TOOLS|TOOL_CALLS|TOOL_RESULTS|SYSTEM_PROMPT)\]|<</?SYS>>"
    r"|</?(?:start_of_turn|end_of_turn|bos|eos|pad|unk|think|tool_call|tool_response|tools|system|user|assistant)>"
    r"|</?(?:knowledge|scene|instruction|warning|refusal)>",
    re.IGNORECASE,
)
"""Control tokens of the common chat templates, and the marks of our own prompt."""
_BRACKETS = re.compile(r"[<>\[\]]")


class HiddenText(msgspec.Struct, frozen=True):
    """What was left out of a reading: `kind`, how many `characters`, and the beginning of it, in ASCII."""

    kind: str
    characters: int
    sample: str


def blank_spans(text: str, spans: Iterable[Span]) -> str:
    """`text` with spaces in place of `spans`; line feeds stay, so that lines keep their numbers."""
    pieces: list[str] = []
    done = 0
    for start, end in sorted(spans):
        if end > done:
            pieces += [text[done : max(start, done)], re.sub(r"[^\n]", " ", text[max(start, done) : end])]
            done = end
    return "".join((*pieces, text[done:]))


def blank_hidden(text: str) -> tuple[str, tuple[HiddenText, ...]]:
    """`text` with unseen characters and chat tokens as blanks, and what they were."""
    unseen = [character for character in dict.fromkeys(text) if _is_invisible(character)]
    lost = sum(map(text.count, unseen)) - text.count("\r\n")
    seen = text.translate(dict.fromkeys(map(ord, unseen), " "))
    found = [HiddenText("unseen characters", lost, ascii("".join(unseen[:12]))[1:-1])] if lost else []
    tokens: list[str] = []
    for _ in range(_PASSES):
        spans = [match.span() for match in _CHAT_TOKENS.finditer(seen)]
        tokens += [seen[start:end] for start, end in spans]
        seen = blank_spans(seen, spans)
    if _CHAT_TOKENS.search(seen):
        seen = _BRACKETS.sub(" ", seen)
    return seen, tuple(found) + summarize_hidden("chat tokens", tokens)


def summarize_hidden(kind: str, pieces: Sequence[str]) -> tuple[HiddenText, ...]:
    """One line for people about `pieces` that were left out, or none if nothing was."""
    kept = [words for piece in pieces if (words := " ".join(piece.split()))]
    if not kept:
        return ()
    sample = " ".join(kept[:20])[:MAX_SAMPLE_CHARACTERS]
    return (HiddenText(kind, sum(map(len, kept)), ascii(sample)[1:-1]),)


def _is_invisible(character: str) -> bool:
    if character in _ALLOWED_CONTROLS:
        return False
    special = character in _FILLERS or any(ord(character) in block for block in _VARIATION_SELECTORS)
    return special or unicodedata.category(character) in _INVISIBLE_CATEGORIES
