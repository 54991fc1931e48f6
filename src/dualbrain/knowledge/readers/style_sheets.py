"""Style sheets of a page: the declarations in effect for each element, as a browser resolves them.

Each page is judged twice: with the rules that always apply, and with those of conditional rules (@media, @supports,
@container) as well; text that is hidden in one of them is hidden. Rules for print and speech are ignored. External
sheets are not read.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Any, NamedTuple

from dualbrain.knowledge.readers.css_hiding import RELEVANT
from dualbrain.knowledge.readers.css_values import MAX_NESTING, Tokens, css_parser, significant, split_at

_FONT_MARKS = ("dimension", "percentage", "function", "number")
_FONT_WORDS = frozenset(
    [
        "xx-small",
        "x-small",
        "small",
        "medium",
        "large",
        "x-large",
        "xx-large",
        "xxx-large",
        "smaller",
        "larger",
        "inherit",
        "initial",
        "unset",
        "revert",
        "caption",
        "icon",
        "menu",
        "message-box",
        "small-caption",
        "status-bar",
    ]
)
_CONDITIONAL = frozenset({"supports", "container", "layer", "scope", "starting-style", "document", "-moz-document"})
_OTHER_MEDIA = frozenset({"print", "speech", "aural", "braille", "tty", "projection", "handheld", "tv"})


class Declaration(NamedTuple):
    """A declared value of one property."""

    name: str
    tokens: tuple[Any, ...]
    important: bool


class Rule(NamedTuple):
    """One selector with its declarations; `conditional` if a condition around it may not hold."""

    selector: str
    declarations: tuple[Declaration, ...]
    specificity: tuple[int, int, int]
    conditional: bool


def parse_declarations(style: str) -> tuple[Declaration, ...]:
    """The declarations of a `style` attribute that can hide text, and custom properties."""
    return _cached_declarations(style)


@lru_cache(maxsize=4096)
def _cached_declarations(style: str) -> tuple[Declaration, ...]:
    found = css_parser().parse_blocks_contents(style, skip_comments=True, skip_whitespace=True)
    return tuple(_declarations(found))


def parse_sheet(text: str) -> Iterator[Rule]:
    """The rules of a style sheet whose declarations can hide text."""
    yield from _rules(css_parser().parse_stylesheet(text, skip_comments=True, skip_whitespace=True), "", False, 0)


def _rules(found: list[Any], parent: str, conditional: bool, depth: int) -> Iterator[Rule]:
    if depth > MAX_NESTING:
        return
    for one in found:
        if one.type == "qualified-rule":
            content = css_parser().parse_blocks_contents(one.content, skip_comments=True, skip_whitespace=True)
            selectors = [_nested(parent, part) for part in split_at(one.prelude, ",")]
            declared = tuple(_declarations(content))
            for selector, specificity in selectors:
                if declared and selector:
                    yield Rule(selector, declared, specificity, conditional)
            inside = ", ".join(selector for selector, _ in selectors if selector)
            nested = [part for part in content if part.type in ("qualified-rule", "at-rule")]
            yield from _rules(nested, inside, conditional, depth + 1)
        elif one.type == "at-rule" and one.content is not None:
            yield from _at_rule(one, parent, conditional, depth)


def _at_rule(rule: Any, parent: str, conditional: bool, depth: int) -> Iterator[Rule]:
    name = str(rule.lower_at_keyword)
    words = {str(token.lower_value) for token in rule.prelude if token.type == "ident"}
    if name == "media":
        if words & _OTHER_MEDIA and not words & {"all", "screen", "not"}:
            return
        always = not any(token.type == "() block" for token in rule.prelude) and "not" not in words
    elif name in _CONDITIONAL:
        always = name == "layer"
    else:
        return
    content = css_parser().parse_blocks_contents(rule.content, skip_comments=True, skip_whitespace=True)
    declared = tuple(_declarations(content))
    if parent and declared:  # declarations directly in a conditional rule that is nested in a rule
        yield Rule(parent, declared, (0, 0, 0), True)
    yield from _rules(content, parent, conditional or not always, depth + 1)


def _nested(parent: str, tokens: Tokens) -> tuple[str, tuple[int, int, int]]:
    """The text of a selector, with the selector of the rule around it, and its specificity."""
    text = str(css_parser().serialize(tokens)).strip()
    if parent and text:
        text = text.replace("&", f":is({parent})") if "&" in text else f":is({parent}) {text}"
    return text, _specificity(tokens)


def _specificity(tokens: Tokens) -> tuple[int, int, int]:
    """Numbers of names, of classes, attributes and pseudo-classes, and of elements (Selectors 4, 16)."""
    names = classes = elements = 0
    after = ""
    for token in tokens:
        match token.type:
            case "hash":
                names += 1
            case "[] block" | "function":
                classes += 1
            case "ident" if after in (".", ":"):
                classes += 1
            case "ident":
                elements += 1
            case _:
                pass
        after = str(token.value) if token.type == "literal" else ""
    return names, classes, elements


def _declarations(found: list[Any]) -> Iterator[Declaration]:
    for one in found:
        if one.type != "declaration":
            continue
        name = str(one.lower_name)
        if name.startswith("--"):
            yield Declaration(str(one.name), tuple(one.value), bool(one.important))
        elif name == "font":
            yield Declaration("font-size", _size_of_font(one.value), bool(one.important))
        elif name in RELEVANT:
            yield Declaration(name, tuple(one.value), bool(one.important))


def _size_of_font(tokens: Tokens) -> tuple[Any, ...]:
    """The size in the value of the shorthand `font`: all of it if none is found, which is then not understood."""
    for token in significant(split_at(tokens, "/")[0]):
        if token.type == "number" and token.is_integer and 100 <= float(token.value) <= 1000:
            continue  # a weight
        if token.type in _FONT_MARKS or (token.type == "ident" and token.lower_value in _FONT_WORDS):
            return (token,)
    return tuple(tokens)


def cascade(found: list[tuple[Rule, int]], inline: tuple[Declaration, ...]) -> dict[str, tuple[Any, ...]]:
    """The values in effect: important ones first, then the `style` attribute, then specificity, then order."""
    best: dict[str, tuple[tuple[Any, ...], tuple[Any, ...]]] = {}
    ranked = [((rule.specificity, order), rule.declarations) for rule, order in found]
    for rank, declarations in (*ranked, (((1 << 30, 0, 0), 0), inline)):
        for place, one in enumerate(declarations):
            key = (one.important, rank, place)
            if one.name not in best or key >= best[one.name][0]:
                best[one.name] = (key, one.tokens)
    return {name: tokens for name, (_, tokens) in best.items()}


def resolve_variables(
    declared: dict[str, tuple[Any, ...]], inherited: dict[str, tuple[Any, ...]]
) -> tuple[dict[str, tuple[Any, ...]], dict[str, tuple[Any, ...]]]:
    """`declared` values with var() replaced, and the custom properties in effect.

    A value with a variable that is not declared and has no fallback is invalid, so that its property is not declared.
    """
    own = {name: tokens for name, tokens in declared.items() if name.startswith("--")}
    variables = {**inherited, **own} if own else inherited
    values: dict[str, tuple[Any, ...]] = {}
    for name, tokens in declared.items():
        if name.startswith("--"):
            continue
        replaced = _replace(tokens, variables, 0)
        if replaced is not None:
            values[name] = replaced
    return values, variables


def _replace(tokens: Tokens, variables: dict[str, tuple[Any, ...]], depth: int) -> tuple[Any, ...] | None:
    if not any(token.type == "function" for token in tokens):
        return tuple(tokens)
    result: list[Any] = []
    for token in tokens:
        if token.type != "function" or str(token.lower_name) != "var":
            result.append(token if token.type != "function" else _replace_inside(token, variables, depth))
            continue
        if depth > MAX_NESTING or len(result) > 1000:
            return None
        name, *fallback = split_at(token.arguments, ",")
        words = significant(name)
        value = variables.get(str(words[0].value)) if len(words) == 1 and words[0].type == "ident" else None
        if value is None:
            value = tuple(part for parts in fallback for part in parts) if fallback else None
        replaced = None if value is None else _replace(value, variables, depth + 1)
        if replaced is None:
            return None
        result += replaced
    return tuple(result)


def _replace_inside(function: Any, variables: dict[str, tuple[Any, ...]], depth: int) -> Any:
    """A function whose arguments have their variables replaced; the function itself if there are none."""
    if depth > MAX_NESTING or not any(token.type == "function" for token in function.arguments):
        return function
    arguments = _replace(function.arguments, variables, depth + 1)
    if arguments is None:
        return function
    return type(function)(function.source_line, function.source_column, function.name, list(arguments))
