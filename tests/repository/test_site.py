"""The documentation site builds without a warning, shows every page and public name, and loads nothing from outside."""

import importlib
import os
import re
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

from tests.repository.test_public_api import NAMESPACES
from tools.site_hooks import on_page_markdown

ROOT = Path(__file__).resolve().parents[2]
DOCS = ROOT / "docs"
LOADED = re.compile(
    r"<(?:script|img|iframe|source)[^>]*\ssrc=[\"']?(https?:)?//|<link[^>]*stylesheet[^>]*href=[\"']?https?://"
)


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    """The site, built with warnings as errors."""
    folder = tmp_path_factory.mktemp("site")
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--quiet", "--site-dir", str(folder)]
    built = subprocess.run(
        command, cwd=ROOT, env={**os.environ, "NO_MKDOCS_2_WARNING": "1"}, capture_output=True, text=True, check=False
    )
    assert built.returncode == 0, built.stderr
    return folder


def html(page):
    """The file of the site that shows a page."""
    return page.with_name("index.html" if page.name == "README.md" else f"{page.stem}.html").relative_to(DOCS)


def test_every_page_is_built_and_in_the_navigation(site):
    navigation = (site / "index.html").read_text("utf-8")
    for page in DOCS.rglob("*.md"):
        assert (site / html(page)).is_file()
        assert f'href="{html(page).as_posix()}"' in navigation or html(page).name == "index.html"


def test_no_page_loads_anything_from_outside(site):
    for page in site.rglob("*.html"):
        assert not LOADED.search(page.read_text("utf-8")), page


def test_links_leave_the_site_for_the_repository_only():
    page = SimpleNamespace(file=SimpleNamespace(src_uri="how-to/page.md"))
    source = (
        "[the memory](../reference/evaluation.md), [Makefile](../../Makefile), [the example](../../examples/02_x.py#L1)"
    )
    config = {"docs_dir": str(DOCS)}
    kept = "[the memory](../reference/evaluation.md), "
    assert on_page_markdown(source, page, config) == kept + "Makefile, the example (`examples/02_x.py`)"
    home = {**config, "repo_url": "https://example.org/dualbrain"}
    assert on_page_markdown(source, page, home) == kept + (
        "[Makefile](https://example.org/dualbrain/blob/main/Makefile), "
        "[the example](https://example.org/dualbrain/blob/main/examples/02_x.py#L1)"
    )


@pytest.mark.parametrize("namespace", NAMESPACES)
def test_every_public_name_has_an_entry(namespace):
    pages = "\n".join(page.read_text("utf-8") for page in (DOCS / "reference" / "api").glob("*.md"))
    shown = {name.rpartition(".")[2] for name in re.findall(r"^::: (\S+)$", pages, re.MULTILINE)}
    assert set(importlib.import_module(namespace).__all__) - {"__version__"} <= shown
