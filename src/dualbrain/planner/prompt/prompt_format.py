"""How a request is put to a model: its messages, the beginning of the answer that is given, what binds the rest."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Any

import msgspec

from dualbrain.planner.decoding.llguidance_grammar import actions_grammar, tail_grammar
from dualbrain.planner.prompt.full_prompt import Message, header, render, template_hash
from dualbrain.planner.prompt.short_prompt import render_short, short_template_hash
from dualbrain.planner.request import PlanRequest

CONSTRAINED_BY = "llguidance in llama.cpp (xllamacpp); header given"
"""The id and context of a contract are given to the model as the beginning of its answer: they are fixed anyway, and
reading them is four times as fast as writing them."""
NOTHING = "nothing"
"""What bound an answer for which no grammar was in force: how such a `constrained_by` begins."""
FREE_BY = f"{NOTHING} (free decoding)"


@dataclass(frozen=True, slots=True)
class Asking:
    """One way of asking. `grammar` makes what binds the answer after its `beginning` from the decoding schema.

    `hears_refusals`: what became of an earlier answer stands in the next prompt. Where it does not, the next shot is
    drawn by chance (temperature 1; see `draw`), for the most probable answer has just failed. `steady`: the prompt
    begins alike for every question, so that a server may keep what it has read of it.
    """

    messages: Callable[[PlanRequest], list[Message]]
    beginning: Callable[[PlanRequest], str]
    grammar: Callable[[dict[str, Any]], str] | None
    template: Callable[[], str]
    hears_refusals: bool
    steady: bool

    def draw(self, request: PlanRequest) -> int | None:
        """The seed with which the answer to `request` is drawn; None where it is the most probable one.

        It follows from the shot and from what failed, so that every try draws anew and the same one can be made again.
        """
        failed = [request.refusal, request.setback]
        if self.hears_refusals or failed == [None, None]:
            return None
        told = msgspec.json.encode([request.contract_id, *failed], order="deterministic")
        return zlib.crc32(told) >> 1  # 31 bits: of 32 the largest means "any" to llama.cpp


def short_messages(request: PlanRequest) -> list[Message]:
    """The prompt that adapters are taught on."""
    return render_short(
        request.scene, request.instruction, robot=request.robot, registry=request.registry_hash,
        contract_id=request.contract_id, recalled=request.recall.exemplars,
    )  # fmt: skip


def short_header(request: PlanRequest) -> str:
    """The beginning of every right answer, up to a place where no tokenizer joins what follows to what was given.

    After a letter comes `":[{"`, which may be one token or three: an adapter was taught the whole text, so the cut must
    be where its tokens are cut anyway.
    """
    return header(request).removesuffix('":')


FULL = Asking(render, header, actions_grammar, template_hash, hears_refusals=True, steady=True)
"""Rules, skills and examples in the prompt: for a model that was taught nothing of this."""
SHORT = Asking(
    short_messages, short_header, tail_grammar, short_template_hash, hears_refusals=False, steady=False
)  # fmt: skip
"""For an adapted model."""


def unbound(asking: Asking) -> Asking:
    """The same question with nothing given of the answer, and nothing that binds it."""
    return replace(asking, beginning=lambda request: "", grammar=None)


FREE = unbound(SHORT)
"""An adapted model left to itself: what it complies with then, it has learnt."""
