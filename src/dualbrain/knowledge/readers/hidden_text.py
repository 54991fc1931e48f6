"""Blanking of invisible characters, and of chat tokens with which a document could imitate another speaker.

Law: blanking preserves the length, so that offsets into the blanked text are offsets into the original text. It is
idempotent, and the result contains no control characters except line feed and tab, no character of a format class
(zero-width, direction, tags), no lone surrogate, and no token of a chat template.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence

import msgspec

from dualbrain.core.untrusted.hidden_characters import is_hidden_character

Span = tuple[int, int]

MAX_SAMPLE_CHARACTERS = 80
_PASSES = 4
"""Number of passes, because blanking a nested token can produce another one; deeper nesting blanks all brackets."""

_ALLOWED_CONTROLS = "\n\t"
_CHAT_TOKENS = re.compile(
    r"<[|\uff5c][^<>\n]{0,60}[|\uff5c]>"  # <|im_start|>, <|start_header_id|>, and with full-width bars
    r"|</?s>|\[/?(?:INST|SYS|AVAILABLE_TOOLS|TOOL_CALLS|TOOL_RESULTS|SYSTEM_PROMPT)\]|<</?SYS>>"
    r"|</?(?:start_of_turn|end_of_turn|bos|eos|pad|unk|think|tool_call|tool_response|tools|system|user|assistant)>"
    r"|</?(?:knowledge|scene|instruction|warning|refusal)>",
    re.IGNORECASE,
)
"""Control tokens of common chat templates, and the tags of the prompts of dualbrain."""
_BRACKETS = re.compile(r"[<>\[\]]")


class HiddenText(msgspec.Struct, frozen=True):
    """Text that was left out of a document text: its kind, its number of characters, and its beginning in ASCII."""

    kind: str
    characters: int
    sample: str


def blank_spans(text: str, spans: Iterable[Span]) -> str:
    """`text` with spaces in place of `spans`; line feeds stay, so that line numbers do not change."""
    pieces: list[str] = []
    position = 0
    for start, end in sorted(spans):
        if end > position:
            first = max(start, position)
            pieces += [text[position:first], re.sub(r"[^\n]", " ", text[first:end])]
            position = end
    return "".join((*pieces, text[position:]))


def blank_hidden(text: str) -> tuple[str, tuple[HiddenText, ...]]:
    """`text` with blanks for invisible characters and chat tokens, and a summary of the blanked text."""
    invisible = [one for one in dict.fromkeys(text) if one not in _ALLOWED_CONTROLS and is_hidden_character(one)]
    count = sum(map(text.count, invisible)) - text.count("\r\n")
    visible = text.translate(dict.fromkeys(map(ord, invisible), " "))
    hidden = [HiddenText("unseen characters", count, ascii("".join(invisible[:12]))[1:-1])] if count else []
    tokens: list[str] = []
    for _ in range(_PASSES):
        spans = [match.span() for match in _CHAT_TOKENS.finditer(visible)]
        tokens += [visible[start:end] for start, end in spans]
        visible = blank_spans(visible, spans)
    if _CHAT_TOKENS.search(visible):
        visible = _BRACKETS.sub(" ", visible)
    return visible, tuple(hidden) + summarize_hidden("chat tokens", tokens)


def summarize_hidden(kind: str, pieces: Sequence[str]) -> tuple[HiddenText, ...]:
    """A summary of the removed `pieces` for people; empty if they contain no text."""
    kept = [words for piece in pieces if (words := " ".join(piece.split()))]
    if not kept:
        return ()
    sample = " ".join(kept[:20])[:MAX_SAMPLE_CHARACTERS]
    return (HiddenText(kind, sum(map(len, kept)), ascii(sample)[1:-1]),)
