"""Reports and the live view show no hidden character of untrusted text."""

import msgspec
import pytest

from dualbrain.core.markdown import code_span, escape_markdown, markdown_table
from dualbrain.records import Episode
from dualbrain.visualization.html.page import Html, badge, document, element, join, section, table
from dualbrain.visualization.live.panel import final_html, lines_html
from tests.core.untrusted.test_visible_text import HIDDEN, TERMINAL_ATTACKS


def assert_visible(page: str) -> None:
    assert not set(page) & (set(HIDDEN) - {"\n", "\t"})
    page.encode()


@pytest.mark.parametrize("text", [HIDDEN, *TERMINAL_ATTACKS])
def test_no_part_of_a_page_hides_text(text: str) -> None:
    parts = (
        element("p", text, title=text),
        join([text]),
        table((text,), [(text,)]),
        badge(text, "bad"),
        section(text, text, note=text),
        lines_html((text,)),
    )
    for part in parts:
        assert_visible(part)
    assert_visible(document(text, text, Html(f"<svg><text>{text}</text></svg>")))
    assert_visible(escape_markdown(text))
    assert_visible(code_span(text))
    assert_visible("".join(markdown_table((text,), [(text,)])))


def test_the_result_of_a_run_is_visible(episode: Episode) -> None:
    outcome = msgspec.structs.replace(episode.outcome, reason=HIDDEN)
    assert_visible(final_html(msgspec.structs.replace(episode, outcome=outcome)))
