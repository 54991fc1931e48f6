"""How a request is put to a model: its messages, the beginning of the answer that is given, what binds the rest."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import msgspec

from dualbrain.planner.decoding.llguidance_grammar import actions_grammar, tail_grammar
from dualbrain.planner.prompt.full_prompt import ChatMessage, answer_header, render, template_hash
from dualbrain.planner.prompt.short_prompt import render_short, short_template_hash
from dualbrain.planner.request import PlanRequest

CONSTRAINED_BY = "llguidance in llama.cpp (xllamacpp); header given"
"""The id and context of a contract are given to the model as the beginning of its answer: they are fixed anyway, and
reading them is four times as fast as writing them."""
NO_CONSTRAINT = "nothing"
"""What bound an answer for which no grammar was in force: how such a `constrained_by` begins."""
UNCONSTRAINED_BY = f"{NO_CONSTRAINT} (free decoding)"


@dataclass(frozen=True, slots=True, kw_only=True)
class PromptFormat:
    """One way of asking. `grammar` makes what binds the answer after its `beginning` from the decoding schema.

    `hears_refusals`: what became of an earlier answer stands in the next prompt. Where it does not, the next shot is
    drawn by chance (temperature 1; see `draw`), for the most probable answer has just failed. `steady`: the prompt
    begins alike for every question, so that a server may keep what it has read of it.
    """

    messages: Callable[[PlanRequest], list[ChatMessage]]
    answer_prefix: Callable[[PlanRequest], str]
    grammar: Callable[[dict[str, Any]], str] | None
    template_hash: Callable[[], str]
    includes_refusals: bool
    has_fixed_prefix: bool

    def sampling_seed(self, request: PlanRequest) -> int | None:
        """The seed with which the answer to `request` is drawn; None where it is the most probable one.

        It follows from the shot and from what failed, so that every try draws anew and the same one can be made again.
        """
        failed = [request.refusal, request.setback]
        if self.includes_refusals or failed == [None, None]:
            return None
        told = msgspec.json.encode([request.contract_id, *failed], order="deterministic")
        return zlib.crc32(told) >> 1  # 31 bits: of 32 the largest means "any" to llama.cpp


def short_messages(request: PlanRequest) -> list[ChatMessage]:
    """The prompt that adapters are taught on."""
    return render_short(
        request.scene,
        request.instruction,
        robot=request.robot,
        registry=request.registry_hash,
        contract_id=request.contract_id,
        exemplars=request.recall.exemplars,
    )


def short_header(request: PlanRequest) -> str:
    """The beginning of every right answer, up to a place where no tokenizer joins what follows to what was given.

    After a letter comes `":[{"`, which may be one token or three: an adapter was taught the whole text, so the cut must
    be where its tokens are cut anyway.
    """
    return answer_header(request).removesuffix('":')


FULL_PROMPT = PromptFormat(
    messages=render,
    answer_prefix=answer_header,
    grammar=actions_grammar,
    template_hash=template_hash,
    includes_refusals=True,
    has_fixed_prefix=True,
)
"""Rules, skills and examples in the prompt: for a model that was taught nothing of this."""
SHORT_PROMPT = PromptFormat(
    messages=short_messages,
    answer_prefix=short_header,
    grammar=tail_grammar,
    template_hash=short_template_hash,
    includes_refusals=False,
    has_fixed_prefix=False,
)
"""For an adapted model."""


def without_constraints(prompt_format: PromptFormat) -> PromptFormat:
    """The same question with nothing given of the answer, and nothing that binds it."""
    return replace(prompt_format, answer_prefix=lambda request: "", grammar=None)


UNCONSTRAINED_SHORT_PROMPT = without_constraints(SHORT_PROMPT)
"""An adapted model left to itself: what it complies with then, it has learnt."""
