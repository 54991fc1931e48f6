"""What a planner reads of a question: its own messages and template where it tells them, else the full prompt."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from dualbrain.planner.prompt.full_prompt import ChatMessage, render, template_hash
from dualbrain.planner.prompt.short_prompt import short_template_hash
from dualbrain.planner.protocol import Planner
from dualbrain.planner.request import PlanRequest
from dualbrain.records import RetrievedContext


def planner_messages(planner: Planner, request: PlanRequest) -> Sequence[ChatMessage]:
    """What `planner` reads for `request`."""
    own: Callable[[PlanRequest], Sequence[ChatMessage]] | None = getattr(planner, "messages", None)
    return own(request) if own else render(request)


def planner_template(planner: Planner) -> str:
    """Hash of the fixed text of the prompt that `planner` reads."""
    own: str | None = getattr(planner, "template", None)
    return own or template_hash()


def unsupported_fields(template: str, recall: RetrievedContext) -> tuple[str, ...]:
    """The fields of `recall` in which something was found that the prompt of `template` has no place for."""
    found = {"warnings": recall.warnings, "passages": recall.passages}
    return tuple(name for name, ones in found.items() if ones) if template == short_template_hash() else ()


def no_documents_reason(planner: Planner) -> str:
    """Why documents never reach `planner`, in words; "" if they do."""
    if planner_template(planner) != short_template_hash():
        return ""
    return f"documents are not shown to {planner.name}: the short prompt of an adapted planner has no place for them"
