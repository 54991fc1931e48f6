"""Reader of HTML: the text that a browser would show, in blocks; nothing is fetched, and no script runs.

Left out and reported: comments, elements that are never shown, and elements hidden by an attribute, by their own style
or by a style sheet in the page. Not detectable without rendering: text that is covered, or hidden by an external sheet
or script.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from importlib import import_module
from typing import Any

from dualbrain.errors import MissingDependencyError
from dualbrain.knowledge.readers.hidden_text import HiddenText, summarize_hidden
from dualbrain.knowledge.rejection import DocumentRejected

MAX_NODES = 200_000
"""Largest number of elements and text nodes of a page."""
MAX_HIDING_RULES = 1000
"""Largest number of hiding rules in the style sheets of a page."""

_NEVER_SHOWN = "script,template,noscript,iframe,object,embed,svg,math,canvas,audio,video,select,textarea"
_BY_ATTRIBUTE = "[hidden],[aria-hidden=true],input[type=hidden],dialog:not([open])"
_HIDING_STYLE = re.compile(
    r"display\s*:\s*none|visibility\s*:\s*(?:hidden|collapse)|content-visibility\s*:\s*hidden"
    r"|opacity\s*:\s*(?:0?\.0\d*|0)(?![\d.]*[1-9])"
    r"|font-size\s*:\s*(?:[0-3](?:\.\d+)?(?:px|pt)?|0?\.[0-3]\d*r?em|[0-9]%)(?![\d.%a-z])|font\s*:\s*0"
    r"|(?<![-\w])color\s*:\s*(?:transparent|white|#fff(?:f|fff|fffff)?(?![0-9a-f])|#[0-9a-f]{3}0(?![0-9a-f])"
    r"|#[0-9a-f]{6}00|rgba?\(\s*255\s*,\s*255\s*,\s*255|rgba\([^)]{0,60},\s*0?\.?0*\s*\))"
    r"|text-indent\s*:\s*-\d{3,}|(?:left|top|right|bottom|margin[-a-z]*)\s*:\s*-\d{3,}"
    r"|clip(?:-path)?\s*:\s*(?:rect\(\s*0|inset\(\s*(?:50|100)|circle\(\s*0|polygon\(\s*0[^,]{0,20}\))"
    r"|transform\s*:[^;}]{0,200}(?:scale[xy3d]*\(\s*0|translate[xy3d]*\(\s*-\d{3,})"
    r"|(?<![-\w])(?:max-)?(?:height|width)\s*:\s*[01](?:px)?\s*(?![\d.%a-z])",
    re.IGNORECASE,
)
_PREFIX = {"li": "- "} | {f"h{level}": "#" * level + " " for level in range(1, 7)}
_BLOCKS = frozenset(_PREFIX) | frozenset(
    {
        "address",
        "article",
        "aside",
        "blockquote",
        "body",
        "br",
        "caption",
        "center",
        "dd",
        "details",
        "div",
        "dl",
        "dt",
        "fieldset",
        "figcaption",
        "figure",
        "footer",
        "form",
        "header",
        "hr",
        "html",
        "legend",
        "main",
        "nav",
        "ol",
        "p",
        "pre",
        "section",
        "summary",
        "table",
        "tbody",
        "tfoot",
        "thead",
        "tr",
        "ul",
    }
)
_CELLS = frozenset({"td", "th"})


def visible_text(source: str) -> tuple[str, tuple[int, ...], tuple[HiddenText, ...]] | DocumentRejected:
    """The text of the page as Markdown-like blocks (headings `#`, list items `-`), no page starts, and the hidden text.

    Raises `MissingDependencyError` without selectolax.
    """
    tree = _parse(source)
    if tree.root is None or tree.body is None:
        return DocumentRejected("not HTML", "no element", "an HTML document")
    nodes = list(tree.root.traverse(include_text=True))
    sheets = _hiding_selectors(tree)
    if len(nodes) > MAX_NODES or len(sheets) > MAX_HIDING_RULES:
        got, allowed = f"{len(nodes)} nodes, {len(sheets)} rules", f"{MAX_NODES} nodes, {MAX_HIDING_RULES} rules"
        return DocumentRejected("too large", got, allowed, "Split it.")
    excluded: set[int] = set()
    hidden = summarize_hidden("comments", [node.comment_content or "" for node in nodes if node.is_comment_node])
    hidden += _exclude(excluded, "style sheets", tree.body.css("style"))
    hidden += _exclude(excluded, "never shown", tree.body.css(_NEVER_SHOWN))
    hidden += _exclude(excluded, "hidden by attribute", tree.root.css(_BY_ATTRIBUTE))
    styled = (
        node for node in tree.root.css("[style]") if _HIDING_STYLE.search(_unescape_css(node.attributes["style"] or ""))
    )
    hidden += _exclude(excluded, "hidden by style", styled)
    for selector in sheets:
        hidden += _exclude_selected(excluded, tree, selector)
    return _render_text(tree.body, excluded), (), hidden


def _parse(source: str) -> Any:
    try:
        return import_module("selectolax.lexbor").LexborHTMLParser(source)
    except ImportError as error:
        raise MissingDependencyError(
            "The package selectolax", fix="Install it with `pip install 'dualbrain[knowledge]'`."
        ) from error


def _unescape_css(style: str) -> str:
    """A style without comments and escapes, which could disguise `display:none`."""
    style = re.sub(r"/\*.*?(?:\*/|\Z)", "", style, flags=re.DOTALL)
    return re.sub(r"\\([0-9a-fA-F]{1,6})\s?|\\", lambda m: chr(int(m[1], 16) % 0x110000) if m[1] else "", style)


def _hiding_selectors(tree: Any) -> list[str]:
    """Selectors of hiding rules in the style sheets of the page; media rules count as if they applied."""
    sheets = " ".join(node.text(deep=True) for node in tree.root.css("style"))
    parts = re.split(r"([{}])", _unescape_css(sheets))
    return [
        parts[k - 2].strip()
        for k in range(2, len(parts) - 1, 2)
        if (parts[k - 1], parts[k + 1]) == ("{", "}") and _HIDING_STYLE.search(parts[k])
    ]


def _exclude_selected(excluded: set[int], tree: Any, selector: str) -> tuple[HiddenText, ...]:
    """Exclude the nodes that `selector` finds; an unsupported selector is reported and excludes nothing."""
    try:
        found = tree.root.css(selector)
    except Exception as error:
        return (
            HiddenText(f"a style rule that was not understood ({type(error).__name__})", 0, ascii(selector[:80])[1:-1]),
        )
    return _exclude(excluded, "hidden by style sheet", found)


def _exclude(excluded: set[int], kind: str, found: Iterable[Any]) -> tuple[HiddenText, ...]:
    """Exclude the nodes `found`, but never the whole page."""
    added = [node for node in found if node.mem_id not in excluded and node.tag not in {"html", "body"}]
    excluded.update(node.mem_id for node in added)
    return summarize_hidden(kind, [node.text(deep=True) for node in added])


def _render_text(body: Any, excluded: set[int]) -> str:
    """The text of the tree without the nodes `excluded`, one paragraph per block."""
    lines = [""]
    todo = [(body, False)]
    while todo:
        node, leaving = todo.pop()
        tag = node.tag
        if tag in _BLOCKS:
            lines.append("" if leaving else _PREFIX.get(tag, ""))
        if leaving or node.mem_id in excluded:
            continue
        if node.is_text_node:
            lines[-1] += re.sub(r"\s+", " ", node.text_content or "")
        elif tag in _CELLS and lines[-1].strip():
            lines[-1] += " | "
        todo += [(node, True), *((child, False) for child in reversed(list(node.iter(include_text=True))))]
    return "\n\n".join(line.strip() for line in lines if line.strip("#- |"))
