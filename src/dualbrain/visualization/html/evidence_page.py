"""Evidence as one HTML page for reading and printing, from the Markdown pages of the evidence folder."""

from __future__ import annotations

from collections.abc import Sequence

from markdown_it import MarkdownIt

from dualbrain.visualization.html.page import Html, document, element, join


def render_evidence_page(pages: Sequence[str]) -> str:
    """One page with a list of contents; markup in the texts is shown as text."""
    parser = MarkdownIt("commonmark", {"html": False}).enable("table")
    titles = [page.partition("\n")[0].removeprefix("# ") for page in pages]
    links = [element("li", element("a", title, href=f"#part-{k}")) for k, title in enumerate(titles) if k]
    sections = [
        element("section", Html(_scrolling(parser.render(page))), id=f"part-{k}") for k, page in enumerate(pages)
    ]
    return document(
        titles[0],
        sections[0],
        element("nav", join([element("h2", "Parts"), element("ul", join(links))])),
        *sections[1:],
    )


def _scrolling(html: str) -> str:
    """Each table in a frame that scrolls, so that a wide one does not widen the page."""
    return html.replace("<table>", '<div class="scroll"><table>').replace("</table>", "</table></div>")
