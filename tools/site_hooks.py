"""Hooks of MkDocs: navigation from the folders, and links from the site to files of the repository."""

from __future__ import annotations

import re
from pathlib import Path
from posixpath import normpath
from typing import Any

SECTIONS = {
    "tutorial": "Tutorial",
    "how-to": "How-to guides",
    "explanation": "Explanation",
    "reference": "Reference",
    "experiments": "Experiments",
    "results": "Results",
    "decisions": "Decisions",
}
"""Folders of `docs/` with the titles of their sections, in the order of the navigation."""
TITLES = {"api": "Python API"}
"""Titles of folders whose name is not their title."""
FIRST = {
    "tutorial": ("first_run.md", "safety_filter.md", "your_robot.md"),
    "explanation": ("architecture.md",),
    "reference": ("installation.md", "glossary.md", "commands.md", "api", "evaluation.md", "paper.md", "migration.md"),
    "reference/api": ("index.md", "safety.md", "robots.md", "contracts.md", "agent.md", "errors.md"),
}
"""Entries that come first in a folder; the others follow in alphabetical order."""
INDEXES = ("index.md", "README.md")
LINK = re.compile(r"!?\[([^\]]*)\]\(([^)\s#]+)(#[^)\s]*)?\)")


def on_config(config: Any) -> Any:
    """Set the navigation: the start page, the sections in order, then pages outside them."""
    docs = Path(config["docs_dir"])
    nav: list[Any] = ["index.md"]
    nav += [{title: section(docs, docs / name)} for name, title in SECTIONS.items() if (docs / name).is_dir()]
    if others := sorted(page.name for page in docs.glob("*.md") if page.name not in INDEXES):
        nav.append({"More": others})
    config["nav"] = nav
    return config


def section(docs: Path, folder: Path) -> list[Any]:
    """Navigation of one folder: its index, its declared entries, its other pages, its other folders."""
    name = folder.relative_to(docs).as_posix()
    first = (*INDEXES, *FIRST.get(name, ()))

    def order(path: Path) -> tuple[int, bool, str]:
        return first.index(path.name) if path.name in first else len(first), path.is_dir(), path.name

    entries: list[Any] = []
    for path in sorted(folder.iterdir(), key=order):
        if path.suffix == ".md":
            entries.append(path.relative_to(docs).as_posix())
        elif path.is_dir() and any(path.rglob("*.md")):
            entries.append({TITLES.get(path.name, path.name.capitalize().replace("_", " ")): section(docs, path)})
    return entries


def on_page_markdown(markdown: str, page: Any, config: Any, **_: Any) -> str:
    """Replace links to files outside `docs/`, or to files that the site leaves out.

    With `repo_url` in mkdocs.yml they lead to the repository, without it to nowhere: the path follows the text.
    """
    docs = Path(config["docs_dir"])
    folder = docs / Path(page.file.src_uri).parent
    repository = config.get("repo_url")

    def replaced(match: re.Match[str]) -> str:
        text, target, anchor = match[1], match[2], match[3] or ""
        if ":" in target or not leaves_site(folder / target, docs):
            return match[0]
        path = Path(normpath(folder / target))
        name = path.relative_to(docs.parent).as_posix()
        if repository:
            return f"[{text}]({repository}/{'tree' if path.is_dir() else 'blob'}/main/{name}{anchor})"
        shown = text.strip("`")
        return text if name == shown else f"`{name}`" if name.endswith(shown) else f"{text} (`{name}`)"

    parts = re.split(r"(^```.*?^```)", markdown, flags=re.MULTILINE | re.DOTALL)
    return "".join(part if part.startswith("```") else LINK.sub(replaced, part) for part in parts)


def leaves_site(target: Path, docs: Path) -> bool:
    """Whether a link's target is neither a page nor an image of the site."""
    path = Path(normpath(target))
    return not path.is_relative_to(docs) or path.is_dir() or path.suffix in {".py", ".parquet"}
