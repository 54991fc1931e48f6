"""HTML pages as trees of elements that escape every plain text, and their common style sheet.

Instructions, scene names and model answers are untrusted text. Only `Html`, made by `element`, is not escaped, and
nowhere does a page contain characters that a reader does not see (`visible_text`).
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from html import escape
from importlib import resources

from dualbrain.core.untrusted.visible_text import visible_text

CONTENT_SECURITY_POLICY = (
    "default-src 'none'; img-src data:; style-src 'unsafe-inline'; base-uri 'none'; form-action 'none'"
)
"""Forbids scripts and all external resources."""

VOID_TAGS = ("img", "br", "meta")


class Html(str):
    """Text that is markup and is not escaped again."""

    __slots__ = ()


def element(tag: str, *children: str, **attributes: str) -> Html:
    """`<tag attributes>children</tag>`; children that are not `Html` are escaped, `class_` is the attribute class."""
    words = "".join(f' {name.rstrip("_").replace("_", "-")}="{_escape(text)}"' for name, text in attributes.items())
    if tag in VOID_TAGS:
        return Html(f"<{tag}{words}>")
    return Html(f"<{tag}{words}>{join(children)}</{tag}>")


def join(parts: Iterable[str]) -> Html:
    """Concatenation of the parts, escaped unless they are `Html`."""
    return Html("".join(part if isinstance(part, Html) else _escape(part) for part in parts))


def table(
    head: Sequence[str], rows: Iterable[Sequence[str]], *, right_aligned: Sequence[int] = (), empty_text: str = "None."
) -> Html:
    """A table; columns in `right_aligned` contain numbers; `empty_text` replaces a table without rows."""
    cells = [[(cell, "number" if k in right_aligned else "text") for k, cell in enumerate(row)] for row in rows]
    if not cells:
        return element("p", empty_text, class_="muted")
    heads = join(element("th", name, class_="number" if k in right_aligned else "text") for k, name in enumerate(head))
    body = join(element("tr", join(element("td", cell, class_=kind) for cell, kind in row)) for row in cells)
    whole = element("table", element("thead", element("tr", heads)), element("tbody", body))
    return element("div", whole, class_="scroll")


def badge(text: str, tone: str) -> Html:
    """A short text in a coloured frame; `tone` is good, warn, bad or quiet."""
    return element("span", text, class_=f"badge {tone}")


def section(title: str, *content: str, note: str = "") -> Html:
    """A section of the page with a title and a note."""
    heading = element("h2", title, join([element("small", note)] if note else []))
    return element("section", heading, *content)


def document(title: str, *content: str) -> str:
    """The whole page, self-contained."""
    head = element(
        "head",
        element("meta", charset="utf-8"),
        element("meta", http_equiv="Content-Security-Policy", content=CONTENT_SECURITY_POLICY),
        element("meta", name="viewport", content="width=device-width, initial-scale=1"),
        element("meta", name="color-scheme", content="light dark"),
        element("title", title),
        element("style", Html(_stylesheet())),
    )
    page = element("html", head, element("body", element("main", *content)), lang="en")
    return f"<!doctype html>\n{visible_text(page, keep_lines=True)}\n"


def palette_css() -> Html:
    """The colours of the page as CSS, for drawings in files of their own."""
    style = _stylesheet()
    return Html(style[style.index(":root") : style.index("* {")])


def _escape(text: str) -> str:
    return escape(visible_text(text, keep_lines=True))


def _stylesheet() -> str:
    return resources.files("dualbrain.visualization.html").joinpath("page.css").read_text(encoding="utf-8")
