"""The default planner: a GGUF model in llama.cpp, in its own process, its answers bound to the contract's grammar."""

from __future__ import annotations

import json
import secrets
import select
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import jsonschema_rs

from dualbrain.errors import InvalidSetup, MissingPart
from dualbrain.planner import protocol
from dualbrain.planner.chat import Answer, ask
from dualbrain.planner.grammar import actions_grammar
from dualbrain.planner.prefix import PrefixStore
from dualbrain.planner.prompt import header, render
from dualbrain.planner.request import PlanRequest
from dualbrain.records import Proposal

CONSTRAINED_BY = "llguidance in llama.cpp (xllamacpp); header given"
"""The id and context of a contract are given to the model as the beginning of its answer: they are fixed anyway, and
reading them is four times as fast as writing them."""

_CHILD = Path(__file__).with_name("llama_child.py")


@dataclass(frozen=True, slots=True)
class LlamaConfig:
    """How the model runs.

    `threads`: 1 beside a control loop, more only on idle cores. `n_ctx` and `max_tokens` in tokens (eight actions fit).
    `timeout_s`: for one proposal, including the load of the model [s]. `prefixes`: an existing folder in which the
    state after the unchanging part of the prompt is kept, so that the next process need not read it again.
    """

    threads: int = 1
    n_ctx: int = 6144
    max_tokens: int = 640
    timeout_s: float = 600.0
    prefixes: Path | None = None


class LlamaPlanner:
    """Proposes with the GGUF model at `model`.

    The child process is started at once and loads while the caller goes on; one that has died or was killed after a
    timeout is started again by the next proposal. It listens on loopback only, behind a random key.
    Raises `MissingPart` when xllamacpp is not installed or `model` is not there.
    """

    def __init__(
        self,
        name: str,
        model: Path,
        config: LlamaConfig = LlamaConfig(),
        *,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        if find_spec("xllamacpp") is None:
            raise MissingPart("The package xllamacpp", fix="Install it with `pip install 'dualbrain[planner]'`.")
        if not model.is_file():
            raise MissingPart(f"The model file of {name!r}", fix=f"Name a GGUF file that exists. {model}")
        self._name, self._model, self._config, self._clock = name, model, config, clock
        self._child: _Child | None = _Child(model, config)

    @property
    def name(self) -> str:
        """Name of the model."""
        return self._name

    @property
    def pid(self) -> int | None:
        """Process id of the child, None while there is none."""
        return self._child.pid if self._child else None

    def propose(self, request: PlanRequest) -> Proposal:
        """Answer `request`; a child that dies, hangs or cannot start becomes a finish reason.

        Raises `InvalidSetup` when `request.schema` is not the schema of a contract.
        """
        begun = self._clock()
        body = self._body(request)
        child = self._child = self._child or _Child(self._model, self._config)
        address, failure = child.address(self._config.timeout_s)
        store = PrefixStore(self._config.prefixes, self._model, self._config.n_ctx, address, child.key)
        if not (failure or child.asked):
            store.restore(request)
        loaded = self._clock()
        left = self._config.timeout_s - (loaded - begun)
        answer = failure or ask(f"{address}/v1/chat/completions", body, key=child.key, timeout_s=left)
        answer = self._after(child, request, answer)
        if answer.finish == protocol.STOP and not child.asked:
            child.asked = True
            store.save(request)
        timings = {"load": loaded - begun, **answer.figures, "total": self._clock() - begun}
        finish = f"{answer.finish}: {answer.detail}" if answer.detail else answer.finish
        return Proposal(answer.text, finish, self._name, CONSTRAINED_BY, timings)

    def close(self) -> None:
        """End the child process."""
        if self._child is not None:
            self._child.close()
            self._child = None

    def _body(self, request: PlanRequest) -> dict[str, Any]:
        try:
            grammar = actions_grammar(request.schema)
            jsonschema_rs.validator_for(request.schema)
        except (KeyError, TypeError, jsonschema_rs.ValidationError) as error:
            raise InvalidSetup("decoding schema", got=str(error), allowed="an object with action_sequence") from error
        messages = [*render(request), {"role": "assistant", "content": header(request)}]
        limits = {"max_tokens": self._config.max_tokens, "temperature": 0.0, "seed": 0, "cache_prompt": True}
        return {"messages": messages, "grammar": grammar, **limits}

    def _after(self, child: _Child, request: PlanRequest, answer: Answer) -> Answer:
        """Put a lost child away, and refuse an answer that does not obey the grammar that was sent."""
        if answer.finish == protocol.ERROR and child.died():
            answer = Answer("", protocol.CRASHED)
        if answer.finish in {protocol.TIMEOUT, protocol.CRASHED} or not child.ready:
            self.close()
        elif answer.finish == protocol.STOP and not _obeys(answer.text, request.schema):
            return Answer("", protocol.ERROR, "the grammar was not applied", answer.figures)
        return answer


class _Child:
    """The child process from its start to its end."""

    def __init__(self, model: Path, config: LlamaConfig) -> None:
        self.key = secrets.token_urlsafe(24)
        self.asked = False
        self._address = ""
        self._process = subprocess.Popen(
            [sys.executable, "-P", str(_CHILD)],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.DEVNULL,
            start_new_session=True,  # Ctrl-C is for the parent, which ends the child in order
        )
        settings = {"model": str(model), "n_ctx": config.n_ctx, "threads": config.threads, "key": self.key}
        settings["prefixes"] = f"{config.prefixes}/" if config.prefixes else ""
        assert self._process.stdin is not None
        with suppress(BrokenPipeError):  # it died at once: `address` will say so
            self._process.stdin.write(json.dumps(settings).encode() + b"\n")
            self._process.stdin.flush()

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def ready(self) -> bool:
        return bool(self._address)

    def died(self) -> bool:
        """Whether it has ended; a socket breaks a moment before its process is gone."""
        with suppress(subprocess.TimeoutExpired):
            self._process.wait(timeout=0.5)
        return self._process.poll() is not None

    def address(self, timeout_s: float) -> tuple[str, Answer | None]:
        """Where the child listens, or why it does not; waits while it loads."""
        if self._address:
            return self._address, None
        out = self._process.stdout
        assert out is not None
        if not select.select([out], [], [], timeout_s)[0]:
            return "", Answer("", protocol.TIMEOUT)
        line = out.readline()
        if not line:
            self._process.wait()
            return "", Answer("", protocol.CRASHED)
        told = json.loads(line)
        self._address = told.get("address", "")
        return self._address, None if self._address else Answer("", protocol.ERROR, told["error"])

    def close(self) -> None:
        """Close its input, which ends it; kill it when it does not answer to that."""
        assert self._process.stdin is not None
        assert self._process.stdout is not None
        self._process.stdin.close()
        try:
            self._process.wait(timeout=1.0)
        except subprocess.TimeoutExpired:
            self._process.kill()
            self._process.wait()
        self._process.stdout.close()


def _obeys(text: str, schema: dict[str, Any]) -> bool:
    """Whether `text` is what the grammar of `schema` admits; else the server has dropped the grammar."""
    try:
        return jsonschema_rs.validator_for(schema).is_valid(json.loads(text))
    except (ValueError, RecursionError):
        return False
