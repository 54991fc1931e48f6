"""The prompt of a planner: its own messages and template if it has them, otherwise the full prompt."""

from __future__ import annotations

from collections.abc import Callable, Sequence

from dualbrain.errors import ConfigurationError
from dualbrain.planner.prompt.full_prompt import ChatMessage, render, template_hash
from dualbrain.planner.prompt.short_prompt import short_template_hash
from dualbrain.planner.protocol import Planner
from dualbrain.planner.request import PlanRequest
from dualbrain.records import RetrievedContext

DEFAULT_LANGUAGES = ("en",)
"""The languages of a planner that declares none: the packaged models were trained on English instructions."""


def planner_messages(planner: Planner, request: PlanRequest) -> Sequence[ChatMessage]:
    """The messages that `planner` sends to its model for `request`."""
    own: Callable[[PlanRequest], Sequence[ChatMessage]] | None = getattr(planner, "messages", None)
    return own(request) if own else render(request)


def planner_template(planner: Planner) -> str:
    """Hash of the fixed text in the prompt of `planner`."""
    own: str | None = getattr(planner, "template", None)
    return own or template_hash()


def unsupported_fields(template: str, recall: RetrievedContext) -> tuple[str, ...]:
    """Names of the non-empty fields of `recall` that the prompt with the hash `template` cannot show."""
    fields = {"warnings": recall.warnings, "passages": recall.passages}
    return tuple(name for name, entries in fields.items() if entries) if template == short_template_hash() else ()


def planner_languages(planner: Planner) -> tuple[str, ...]:
    """The languages that `planner` declares, as ISO 639-1 codes ("*": all); English if it declares none."""
    own: tuple[str, ...] | None = getattr(planner, "languages", None)
    return own or DEFAULT_LANGUAGES


def takes_images(planner: Planner) -> bool:
    """Whether `planner` sends the image of a request to its model."""
    return bool(getattr(planner, "takes_images", False))


def require_image_input(planner: Planner) -> None:
    """Raise `ConfigurationError` for a planner that would ignore the image of a request."""
    if not takes_images(planner):
        raise ConfigurationError.stating(
            f"The planner {planner.name} takes no image.",
            fix="Leave out the image, or name a server with a vision-language model: --planner http://HOST/v1#MODEL",
        )


def no_documents_reason(planner: Planner) -> str:
    """The reason why documents are never shown to `planner`; "" if they are shown."""
    if planner_template(planner) != short_template_hash():
        return ""
    return f"documents are not shown to {planner.name}: the short prompt of an adapted planner has no place for them"
