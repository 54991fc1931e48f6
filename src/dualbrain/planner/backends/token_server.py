"""Requests of single tokens to the llama.cpp server of a worker, over one kept connection.

The server keeps the state of the tokens that it has read, so that each request of one answer reads only the tokens that
are new in it. A connection serves one answer.
"""

from __future__ import annotations

import http.client
import json
import time
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from typing import Any
from urllib.parse import urlsplit

from dualbrain.planner.decoding.jump_forward import JumpForwardError, Token, TokenCandidate

N_CANDIDATES = 40
"""Number of likeliest tokens that the server returns; the grammar usually admits one of the first ten."""


class TokenServer:
    """One answer of the server at `address` (loopback), with the adapters in `options`.

    `reuse_prompt`: whether the first request may use the state of earlier answers. `timeout_s` [s] limits all requests
    together. Silence raises `TimeoutError`, every other failure of the server `JumpForwardError`.
    """

    def __init__(
        self, address: str, key: str, options: dict[str, Any], *, reuse_prompt: bool, timeout_s: float
    ) -> None:
        self._connection = http.client.HTTPConnection(urlsplit(address).netloc)
        self._headers = {"Content-Type": "application/json", "Authorization": f"Bearer {key}"}
        self._options, self._reuse, self._deadline = options, reuse_prompt, time.monotonic() + timeout_s
        self._pieces: dict[str, list[Token]] = {}
        self.prompt: list[int] = []
        self.metrics: dict[str, float] = {"prefill": 0.0, "decode": 0.0}

    def read_prompt(self, messages: Sequence[Any]) -> None:
        """Divide the prompt with `messages` into tokens; the last message may be the beginning of the answer."""
        with _malformed_replies():
            text = self._post("/apply-template", {"messages": list(messages)})["prompt"]
            body = {"content": text, "add_special": True, "parse_special": True}
            self.prompt = list(self._post("/tokenize", body)["tokens"])

    def tokenize(self, text: str) -> list[Token]:
        """The tokens of `text`, which contains no control tokens."""
        if text not in self._pieces:
            body = {"content": text, "add_special": False, "parse_special": False, "with_pieces": True}
            with _malformed_replies():
                tokens = self._post("/tokenize", body)["tokens"]
                self._pieces[text] = [(one["id"], _piece(one["piece"])) for one in tokens]
        return self._pieces[text]

    def candidates(self, answer: Sequence[int]) -> list[TokenCandidate]:
        """The likeliest tokens after the prompt and the tokens of `answer`, likeliest first."""
        body = {"prompt": [*self.prompt, *answer], "n_predict": 1, "n_probs": N_CANDIDATES, "temperature": 0.0}
        body |= {"cache_prompt": self._reuse, "seed": 0, **self._options}
        with _malformed_replies():
            reply = self._post("/completion", body)
            self._measure(reply["timings"])
            self._reuse = True  # the state is now that of this answer
            found = reply["completion_probabilities"][0]["top_logprobs"]
            return [TokenCandidate(one["id"], bytes(one["bytes"])) for one in found]

    def close(self) -> None:
        """Close the connection."""
        self._connection.close()

    def _measure(self, timings: dict[str, Any]) -> None:
        is_first = "prompt_tokens" not in self.metrics
        part = "prefill" if is_first else "decode"
        self.metrics[part] += 1e-3 * (timings["prompt_ms"] + timings["predicted_ms"])
        if is_first:
            self.metrics |= {"prompt_tokens": float(len(self.prompt)), "cached_tokens": float(timings["cache_n"])}

    def _post(self, path: str, body: dict[str, Any]) -> dict[str, Any]:
        if (remaining := self._deadline - time.monotonic()) <= 0.0:
            raise TimeoutError
        self._connection.timeout = remaining
        if self._connection.sock is not None:
            self._connection.sock.settimeout(remaining)
        self._connection.request("POST", path, json.dumps(body), self._headers)
        reply = self._connection.getresponse()
        data = reply.read()
        if reply.status != http.client.OK:
            raise JumpForwardError(f"status {reply.status}")
        return json.loads(data)


@contextmanager
def _malformed_replies() -> Generator[None]:
    """Raise `JumpForwardError` instead of the errors of a lost connection and of a reply of another form."""
    try:
        yield
    except TimeoutError:
        raise
    except (OSError, http.client.HTTPException, ValueError, LookupError, TypeError) as error:
        raise JumpForwardError(type(error).__name__) from error


def _piece(piece: str | list[int]) -> bytes:
    """The bytes of a token, which the server sends as text if they are valid UTF-8."""
    return piece.encode() if isinstance(piece, str) else bytes(piece)
