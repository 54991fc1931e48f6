"""Prompt formats: the messages for a model, the given beginning of its answer, and the grammar of the rest."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import msgspec

from dualbrain.planner.decoding.llguidance_grammar import actions_grammar, tail_grammar
from dualbrain.planner.prompt.answer_form import ACTIONS_ONLY, WHOLE_CONTRACT
from dualbrain.planner.prompt.full_prompt import (
    ChatMessage,
    local_template_hash,
    render,
    render_local,
    template_hash,
)
from dualbrain.planner.prompt.short_prompt import render_short, short_template_hash
from dualbrain.planner.request import PlanRequest

CONSTRAINED_BY = "llguidance in llama.cpp (xllamacpp)"
"""Beginning of `constrained_by`; `PromptFormat.header_note` follows."""
NO_CONSTRAINT = "nothing"
"""Prefix of `constrained_by` for an answer without a grammar."""
UNCONSTRAINED_BY = f"{NO_CONSTRAINT} (free decoding)"


@dataclass(frozen=True, slots=True, kw_only=True)
class PromptFormat:
    """One format of prompts and answers.

    `answer_prefix` is the given beginning of the answer, `grammar` converts the decoding schema to the grammar of the
    rest (None: no constraint). Id and context of a contract are fixed by the program. With `inserts_header`, the model
    does not read them, and the program writes them in place of the given beginning (`contract_prefix`); otherwise they
    are part of the given beginning, because reading is four times as fast as generating. The text of a proposal is that
    of a contract in both cases. With `includes_rejections`, the model is expected to follow the description of a
    failure in the next prompt. Without it, the next answer is sampled (temperature 1; see `sampling_seed`), because the
    most probable answer has failed and no training data contains such a description. With `has_fixed_prefix`, all
    prompts begin with the same text, so that a server can cache its state.
    """

    messages: Callable[[PlanRequest], list[ChatMessage]]
    answer_prefix: Callable[[PlanRequest], str]
    grammar: Callable[[dict[str, Any]], str] | None
    template_hash: Callable[[], str]
    includes_rejections: bool
    has_fixed_prefix: bool
    inserts_header: bool

    @property
    def header_note(self) -> str:
        """The origin of id and context in an answer, for `constrained_by`."""
        return "header inserted" if self.inserts_header else "header given"

    def contract_prefix(self, request: PlanRequest) -> str:
        """The beginning of a proposal's text, which replaces the given beginning of the answer."""
        return WHOLE_CONTRACT.answer_prefix(request) if self.inserts_header else self.answer_prefix(request)

    def complete(self, request: PlanRequest, answer: str) -> str:
        """`answer` with the beginning of a contract; an answer without the given beginning is unchanged."""
        given = self.answer_prefix(request)
        return self.contract_prefix(request) + answer.removeprefix(given) if answer.startswith(given) else answer

    def sampling_seed(self, request: PlanRequest) -> int | None:
        """The seed for sampling the answer to `request`; None for the most probable answer.

        The seed is derived from the attempt and the failure, so that every attempt is sampled differently and can be
        reproduced.
        """
        failed = [request.rejection, request.failure_feedback]
        if self.includes_rejections or failed == [None, None]:
            return None
        attempt = msgspec.json.encode([request.contract_id, *failed], order="deterministic")
        return zlib.crc32(attempt) >> 1  # 31 bits, because llama.cpp reads the largest 32-bit value as "any seed"


def short_messages(request: PlanRequest) -> list[ChatMessage]:
    """The prompt on which adapters are trained."""
    return _render_short(request, request.scene)


def short_messages_with_values(request: PlanRequest) -> list[ChatMessage]:
    """The prompt of adapters that were trained with fitting parameter values in the scene."""
    return _render_short(request, request.scene_with_values or request.scene)


def _render_short(request: PlanRequest, scene: str) -> list[ChatMessage]:
    return render_short(
        scene,
        request.instruction,
        robot=request.robot,
        registry=request.registry_hash,
        contract_id=request.contract_id,
        exemplars=request.recall.exemplars,
        rejection=request.rejection,
        failure_feedback=request.failure_feedback,
    )


def short_header(request: PlanRequest) -> str:
    """The beginning of every valid answer, up to a position that is a token boundary in every tokenizer.

    The continuation `":[{"` after a letter may be one token or three. Adapters are trained on the whole text, so the
    given beginning must end at a boundary of its tokens.
    """
    return WHOLE_CONTRACT.answer_prefix(request).removesuffix('":')


FULL_PROMPT = PromptFormat(
    messages=render,
    answer_prefix=WHOLE_CONTRACT.answer_prefix,
    grammar=actions_grammar,
    template_hash=template_hash,
    includes_rejections=True,
    has_fixed_prefix=True,
    inserts_header=False,
)
"""Format with rules, skills and examples in the prompt, for a model without an adapter behind a server."""
LOCAL_FULL_PROMPT = replace(
    FULL_PROMPT,
    messages=render_local,
    answer_prefix=ACTIONS_ONLY.answer_prefix,
    template_hash=local_template_hash,
    inserts_header=True,
)
"""Format with rules, skills and examples in the prompt, for a model without an adapter in this process."""
SHORT_PROMPT = PromptFormat(
    messages=short_messages,
    answer_prefix=short_header,
    grammar=tail_grammar,
    template_hash=short_template_hash,
    includes_rejections=False,
    has_fixed_prefix=False,
    inserts_header=False,
)
"""Format for an adapted model."""
SHORT_PROMPT_WITH_VALUES = replace(SHORT_PROMPT, messages=short_messages_with_values)
"""Format for a model that was adapted with fitting parameter values in the scene."""


def short_prompt(*, scene_values: bool) -> PromptFormat:
    """The format for an adapted model, with or without fitting parameter values in the scene."""
    return SHORT_PROMPT_WITH_VALUES if scene_values else SHORT_PROMPT


def without_constraints(prompt_format: PromptFormat) -> PromptFormat:
    """The same messages without a given beginning of the answer and without a grammar.

    Raises `ValueError` for a format that inserts id and context, because its prompt does not state them.
    """
    if prompt_format.inserts_header:
        raise ValueError("without a given beginning, the model must write id and context itself")
    return replace(prompt_format, answer_prefix=lambda request: "", grammar=None)


UNCONSTRAINED_SHORT_PROMPT = without_constraints(SHORT_PROMPT)
"""Format for an adapted model without constraints, for measuring how well it keeps to the schema by itself."""
