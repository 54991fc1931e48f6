"""Jump-forward decoding: text that the grammar forces is read by the model in one batch, and not generated.

About three quarters of a contract follow from its grammar (Zheng et al. 2024, "SGLang", section 4). The grammar is
followed byte by byte, because forced *tokens* are not those on which a model was trained (see `llguidance_grammar`).
Forced bytes are divided into tokens by the tokenizer of the model, and the tokens at their end that another
continuation would divide differently are left to the model. At every other place the model chooses the likeliest token
that the grammar admits, as in decoding token by token.

The answer is a function of model, grammar and prompt, like that of decoding token by token, and differs from it only
where rounding decides between two tokens: logits of a batch differ from those of single tokens in their last bits
(`docs/reference/planners.md` states how often a contract differs).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from itertools import takewhile
from typing import Any

import numpy as np

from dualbrain.core.lazy_exports import missing_dependency
from dualbrain.planner.decoding.llguidance_grammar import NO_FORCING

Token = tuple[int, bytes]
"""Id and bytes of a token."""
Tokenize = Callable[[str], Sequence[Token]]
"""Divides a text into tokens as the model does; the text contains no control tokens."""

MAX_CONTINUATIONS = 24
"""Largest number of next bytes for which the division of forced text into tokens is compared."""


@dataclass(frozen=True, slots=True)
class TokenCandidate:
    """A token that the model may choose next: its id and its bytes, which are empty for a control token."""

    id: int
    text: bytes


class JumpForwardError(Exception):
    """No answer by jump-forward decoding; the caller decodes token by token. The text states the reason."""


@dataclass(slots=True, kw_only=True)
class JumpForwardDecoder:
    """Decodes one answer.

    `candidates` returns the likeliest tokens after the answer so far, likeliest first. `show` receives the text of the
    answer after each step; this text is for display only, because it is neither complete nor checked.
    """

    grammar: str
    tokenize: Tokenize
    candidates: Callable[[Sequence[int]], Sequence[TokenCandidate]]
    max_tokens: int
    show: Callable[[str], None] = lambda text: None
    tokens: list[int] = field(default_factory=list[int])
    text: bytes = b""
    n_steps: int = 0
    is_complete: bool = False

    def decode(self) -> str:
        """The complete answer, or its beginning if it has `max_tokens` tokens.

        Raises `JumpForwardError` if the grammar cannot be followed with these candidates.
        """
        matcher = _make_matcher(self.grammar)
        self._read_forced(matcher)
        while not matcher.is_stopped() and len(self.tokens) < self.max_tokens:
            self._choose(matcher)
            self._read_forced(matcher)
            self.show(self.text.decode(errors="ignore"))
        self.is_complete = bool(matcher.is_stopped())
        return self.text.decode(errors="ignore")

    def _read_forced(self, matcher: Any) -> None:
        """Append the tokens of the forced text that every continuation has in common."""
        for token, text in forced_tokens(matcher, self.tokenize):
            self._append(matcher, token, text)

    def _choose(self, matcher: Any) -> None:
        """Append the likeliest admitted token."""
        self.n_steps += 1
        admitted = [one for one in self.candidates(self.tokens) if _is_admitted(matcher, one.text)]
        if not admitted or matcher.is_accepting():
            raise JumpForwardError("the grammar admits none of the likeliest tokens, or an end")
        self._append(matcher, admitted[0].id, admitted[0].text)

    def _append(self, matcher: Any, token: int, text: bytes) -> None:
        if not matcher.consume_tokens(list(text)):
            raise JumpForwardError(f"the grammar does not admit {text!r}: {matcher.get_error()}")
        self.tokens.append(token)
        self.text += text


def forced_tokens(matcher: Any, tokenize: Tokenize) -> list[Token]:
    """The tokens of the text that `matcher` forces, without those at its end that depend on the text after it."""
    forced: bytes = matcher.compute_ff_bytes()
    try:
        ways = [tokenize((forced + after).decode()) for after in _continuations(matcher, forced)] if forced else []
    except UnicodeDecodeError:  # the forced text ends within a character
        return []
    common = [same[0] for same in takewhile(_are_equal, zip(*ways, strict=False))]
    kept = list[Token]()
    for token, text in common:
        begin = b"".join(one for _, one in kept) + text
        if not forced.startswith(begin):
            break
        kept.append((token, text))
    return kept


def _continuations(matcher: Any, forced: bytes) -> list[bytes]:
    """For each byte that may follow `forced`: this byte and the text that is forced after it. b"" at the end.

    Of more than `MAX_CONTINUATIONS` bytes every n-th is taken: a free text follows a quotation mark, and the letters
    that may begin it divide the text before it in the same way.
    """
    ahead = matcher.deep_copy()
    ahead.consume_tokens(list(forced))
    if ahead.is_stopped():
        return [b""]
    bits = np.unpackbits(np.frombuffer(ahead.compute_bitmask(), np.uint8), bitorder="little")
    following = [int(one) for one in np.flatnonzero(bits[:128])]
    found = list[bytes]()
    for byte in following[:: 1 + len(following) // MAX_CONTINUATIONS]:
        branch = ahead.deep_copy()
        branch.consume_tokens([byte])
        found.append(bytes([byte]) + (b"" if branch.is_stopped() else branch.compute_ff_bytes()))
    return found


def _are_equal(tokens: Sequence[Token]) -> bool:
    return all(one == tokens[0] for one in tokens)


def _is_admitted(matcher: Any, text: bytes) -> bool:
    """Whether `text` may come next; a control token has no text and is never admitted."""
    return bool(text) and matcher.validate_tokens(list(text)) == len(text)


def _make_matcher(grammar: str) -> Any:
    """A matcher of single bytes at the beginning of `grammar`.

    Raises `JumpForwardError` if LLGuidance cannot parse it, and `MissingDependencyError` without LLGuidance.
    """
    tokenizer, from_lark, matcher_type = _llguidance()
    matcher = matcher_type(tokenizer, from_lark("lark", grammar.removeprefix(NO_FORCING)))
    if matcher.is_error():
        raise JumpForwardError(matcher.get_error())
    return matcher


@cache
def _llguidance() -> tuple[Any, Any, Any]:
    """A vocabulary with one token for each byte, the reader of grammars, and the type of matchers."""
    try:
        import llguidance  # noqa: PLC0415  (an extra)
    except ModuleNotFoundError as error:
        raise missing_dependency(error, "jump-forward decoding") from error
    return llguidance.LLTokenizer("byte"), llguidance.grammar_from, llguidance.LLMatcher
