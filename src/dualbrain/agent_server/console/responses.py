"""Responses of the console: JSON in which every hidden character is visible, and security headers."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import msgspec
from starlette.responses import Response

from dualbrain.core.untrusted.visible_text import visible_text

PAGE_POLICY = "; ".join(
    (
        "default-src 'none'",
        "script-src 'self'",
        "style-src 'self'",
        "img-src 'self' data:",
        "connect-src 'self'",
        "frame-src 'self'",
        "frame-ancestors 'none'",
        "base-uri 'none'",
        "form-action 'none'",
        "require-trusted-types-for 'script'",  # no text becomes markup
    )
)
"""Content Security Policy of the page: only its own files, no inline script, and no markup from text."""
REPORT_POLICY = "; ".join(
    (
        "sandbox",  # an origin of its own: no script, and no access to the page or its token
        "default-src 'none'",
        "img-src data:",
        "style-src 'unsafe-inline'",
        "frame-ancestors 'self'",
        "base-uri 'none'",
        "form-action 'none'",
    )
)
"""Content Security Policy of a report, which contains text of planners, scenes and clients."""
COMMON_HEADERS = {
    "X-Content-Type-Options": "nosniff",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cache-Control": "no-store",
}


def response(content: bytes, media_type: str, *, status: int = 200, policy: str = PAGE_POLICY) -> Response:
    """A response with security headers and the Content Security Policy `policy`."""
    headers = {**COMMON_HEADERS, "Content-Security-Policy": policy}
    return Response(content, status, headers, media_type)


def json_response(value: Any, status: int = 200) -> Response:
    """`value` as JSON; hidden characters of its texts appear as escapes that a reader sees."""
    return response(encode_visible(value), "application/json", status=status)


def error_response(sentence: str, status: int) -> Response:
    """A refusal as JSON: {"error": SENTENCE}."""
    return json_response({"error": sentence}, status)


def encode_visible(value: Any) -> bytes:
    """`value` as JSON text, with every hidden character of its texts made visible."""
    return msgspec.json.encode(_visible(msgspec.to_builtins(value)))


def _visible(value: Any) -> Any:
    if isinstance(value, str):
        return visible_text(value, keep_lines=True)
    if isinstance(value, Mapping):
        return {visible_text(str(key)): _visible(one) for key, one in value.items()}
    return [_visible(one) for one in value] if isinstance(value, list | tuple) else value
