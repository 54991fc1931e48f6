"""Reader of HTML: the text that a browser would show, in blocks; nothing is fetched, and no script runs.

Left out and reported: comments, elements that are never shown, and elements hidden by an attribute, by their own style
or by a style sheet in the page (`css_hiding` states the thresholds). Not detectable without rendering: text that is
covered, or hidden by an external sheet or script.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib import import_module
from typing import Any

from dualbrain.errors import MissingDependencyError
from dualbrain.knowledge.readers.css_hiding import TextStyle, computed_style, element_reason
from dualbrain.knowledge.readers.hidden_text import HiddenText, summarize_hidden
from dualbrain.knowledge.readers.style_sheets import (
    Declaration,
    Rule,
    cascade,
    parse_declarations,
    parse_sheet,
    resolve_variables,
)
from dualbrain.knowledge.rejection import DocumentRejected

MAX_NODES = 200_000
"""Largest number of elements and text nodes of a page."""
MAX_RULES = 10_000
"""Largest number of rules in the style sheets of a page."""

_NEVER_SHOWN = frozenset(
    [
        "script",
        "template",
        "noscript",
        "iframe",
        "object",
        "embed",
        "applet",
        "svg",
        "math",
        "canvas",
        "audio",
        "video",
        "select",
        "option",
        "optgroup",
        "textarea",
        "datalist",
        "noframes",
        "noembed",
        "frameset",
        "progress",
        "meter",
        "rp",
        "style",
        "title",
        "head",
    ]
)
_HIDING_ATTRIBUTES: dict[str, Callable[[str], bool]] = {
    "hidden": lambda _: True,
    "popover": lambda _: True,
    "aria-hidden": lambda value: value.strip().lower() == "true",
}
_NO_RANK = (-1, 0, 0)
"""Specificity of presentational attributes, below that of every rule (HTML, 15.2)."""
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


@dataclass(slots=True)
class _Excluded:
    """The nodes that are left out, and their texts by kind."""

    nodes: set[int] = field(default_factory=set[int])
    texts: dict[str, list[str]] = field(default_factory=dict[str, list[str]])

    def add(self, kind: str, node: Any) -> None:
        if node.mem_id not in self.nodes:
            self.nodes.add(node.mem_id)
            self.texts.setdefault(kind, []).append(node.text(deep=True) if not node.is_text_node else node.text_content)


Variables = dict[str, tuple[Any, ...]]
View = tuple[TextStyle, Variables]
"""The style and the custom properties that are inherited, when the page is judged with or without conditional rules."""


def visible_text(source: str) -> tuple[str, tuple[int, ...], tuple[HiddenText, ...]] | DocumentRejected:
    """The text of the page as Markdown-like blocks (headings `#`, list items `-`), no page starts, and the hidden text.

    Raises `MissingDependencyError` without selectolax or tinycss2.
    """
    tree = _parse(source)
    if tree.root is None or tree.body is None:
        return DocumentRejected("not HTML", "no element", "an HTML document")
    nodes = list(tree.root.traverse(include_text=True))
    rules = list(parse_sheet("\n".join(node.text(deep=True) for node in tree.root.css("style"))))
    if len(nodes) > MAX_NODES or len(rules) > MAX_RULES:
        got, allowed = f"{len(nodes)} nodes, {len(rules)} rules", f"{MAX_NODES} nodes, {MAX_RULES} rules"
        return DocumentRejected("too large", got, allowed, "Split it.")
    hidden = summarize_hidden("comments", [node.comment_content or "" for node in nodes if node.is_comment_node])
    matched, unclear = _match(tree, rules)
    excluded = _exclude(tree, matched, has_conditions=any(rule.conditional for rule in rules))
    for kind, texts in excluded.texts.items():
        hidden += summarize_hidden(kind, texts)
    return _render_text(tree.body, excluded.nodes), (), (*hidden, *unclear)


def _parse(source: str) -> Any:
    try:
        return import_module("selectolax.lexbor").LexborHTMLParser(source)
    except ImportError as error:
        raise MissingDependencyError(
            "The package selectolax", fix="Install it with `pip install 'dualbrain[knowledge]'`."
        ) from error


def _match(tree: Any, rules: list[Rule]) -> tuple[dict[int, list[tuple[Rule, int]]], tuple[HiddenText, ...]]:
    """The rules of each element with their order; an unsupported selector is reported and selects nothing."""
    matched: dict[int, list[tuple[Rule, int]]] = {}
    unclear: dict[str, str] = {}
    for order, rule in enumerate(rules):
        if "::" in rule.selector.replace(":::", "") and ":::" not in rule.selector:
            continue  # a part of an element, such as ::before
        try:
            found = tree.root.css(rule.selector)
        except Exception as error:  # the parser of selectors raises several kinds
            kind = f"a style rule that was not understood ({type(error).__name__})"
            unclear.setdefault(kind, ascii(rule.selector[:80])[1:-1])
            continue
        for node in found:
            matched.setdefault(node.mem_id, []).append((rule, order))
    return matched, tuple(HiddenText(kind, 0, sample) for kind, sample in unclear.items())


# --- text left out --------------------------------------------------------------------------------------------------


def _exclude(tree: Any, matched: Mapping[int, list[tuple[Rule, int]]], *, has_conditions: bool) -> _Excluded:
    """Walk through the page from the outside to the inside, with the inherited style of each view."""
    excluded = _Excluded()
    start: tuple[View, ...] = ((TextStyle(), Variables()),) * (2 if has_conditions else 1)
    todo: list[tuple[Any, tuple[View, ...]]] = [(tree.root, start)]
    while todo:
        node, parents = todo.pop()
        tag = node.tag
        attributes = node.attributes
        if kind := _hidden_kind(tag, attributes):
            excluded.add(kind, node)
            continue
        views: list[View] = []
        reason = ""
        for index, (style, variables) in enumerate(parents):
            rules = [one for one in matched.get(node.mem_id, ()) if index or not one[0].conditional]
            declared = _declared(tag, attributes, rules)
            values, variables = resolve_variables(declared, variables)  # noqa: PLW2901
            style = computed_style(values, style) if values else style  # noqa: PLW2901
            reason = reason or (element_reason(values, style) if values else "")
            views.append((style, variables))
        if reason and tag not in ("html", "body"):
            excluded.add("hidden by style", node)
            continue
        todo += [(child, tuple(views)) for child in _shown_children(node, tag, attributes, views, excluded)]
    return excluded


def _shown_children(
    node: Any, tag: str, attributes: Mapping[str, str | None], views: list[View], excluded: _Excluded
) -> Iterator[Any]:
    """The elements in `node`; excludes its own text where that is not seen, and the content of a closed details."""
    closed = tag == "details" and "open" not in attributes
    unseen = any(style.reason for style, _ in views)
    has_summary = False
    for child in node.iter(include_text=True):
        if child.is_comment_node:
            continue
        if closed and (child.tag != "summary" or has_summary):
            excluded.add("closed details", child)
        elif child.is_text_node:
            if unseen and (child.text_content or "").strip():
                excluded.add("hidden by style", child)
        else:
            has_summary = has_summary or child.tag == "summary"
            yield child


def _hidden_kind(tag: str, attributes: Mapping[str, str | None]) -> str:
    if tag in _NEVER_SHOWN:
        return "style sheets" if tag == "style" else "never shown"
    if tag == "dialog" and "open" not in attributes:
        return "hidden by attribute"
    by_attribute = any(
        hides(attributes[name] or "") for name, hides in _HIDING_ATTRIBUTES.items() if name in attributes
    )
    return "hidden by attribute" if by_attribute else ""


def _declared(tag: str, attributes: Mapping[str, str | None], rules: list[tuple[Rule, int]]) -> Variables:
    """The values in effect of an element: of its attributes, of the rules, and of its own style."""
    presentational = _presentational(tag, attributes)
    style = attributes.get("style")
    if not (presentational or style or rules):
        return {}
    if presentational:
        rules = [(Rule("", presentational, _NO_RANK, False), -1), *rules]
    return cascade(rules, parse_declarations(style) if style else ())


def _presentational(tag: str, attributes: Mapping[str, str | None]) -> tuple[Declaration, ...]:
    """The declarations that attributes of old HTML stand for: colours of text and background."""
    named = {"bgcolor": "background-color"}
    if tag == "body":
        named["text"] = "color"
    elif tag == "font":
        named["color"] = "color"
    texts = [f"{name}:{_legacy_colour(attributes[key] or '')}" for key, name in named.items() if key in attributes]
    return parse_declarations(";".join(texts)) if texts else ()


def _legacy_colour(value: str) -> str:
    """A colour of old HTML as CSS: hexadecimal digits may come without their #."""
    value = value.strip()
    return f"#{value}" if re.fullmatch(r"[0-9a-fA-F]{3}|[0-9a-fA-F]{6}", value) else value.partition(";")[0]


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
