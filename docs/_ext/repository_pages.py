"""Markdown pages from outside of docs/ as pages of the site.

A page of docs/ that begins with `<!-- page: ../../results/recipe/README.md -->` becomes that file. Links to such files,
from each other and from any page, become links to their pages; pictures are found where they lie, and other files of
the checkout are offered as downloads.
"""

import os
import re
from pathlib import Path
from typing import Any

from figures import with_figures
from sphinx.application import Sphinx

DOCS = Path(__file__).resolve().parents[1]
MARKER = re.compile(r"<!-- page: (\S+) -->")
TARGET = re.compile(r"(?P<image>!?)\[(?P<text>(?:[^\[\]]|\[[^\]]*\])*)\]\((?P<target>[^)\s#]+)(?P<anchor>#[^)\s]*)?\)")


def setup(app: Sphinx) -> dict[str, Any]:
    app.connect("builder-inited", _find_pages)
    app.connect("source-read", _read)
    return {"parallel_read_safe": True}


def _find_pages(app: Sphinx) -> None:
    """Which page of the site each file outside has become."""
    app.env.repository_pages = {}  # type: ignore[attr-defined]
    for page in sorted(Path(app.srcdir).rglob("*.md")):
        if match := MARKER.match(page.read_text()):
            app.env.repository_pages[_file(page, match[1])] = page  # type: ignore[attr-defined]


def _read(app: Sphinx, name: str, source: list[str]) -> None:
    page = file = Path(app.env.doc2path(name))
    text = source[0]
    if match := MARKER.match(text):
        file = _file(page, match[1])
        app.env.note_dependency(str(file))
        text = file.read_text()
    text = with_figures(text, file)
    source[0] = TARGET.sub(lambda link: _moved(link, file, page, app.env.repository_pages), text)  # type: ignore[attr-defined]


def _moved(link: re.Match[str], file: Path, page: Path, pages: dict[Path, Path]) -> str:
    """A link of `file` as it has to be in `page`."""
    if ":" in link["target"]:
        return link[0]
    target = _file(file, link["target"])
    if not target.is_file():
        raise ValueError(f"{file}: {link['target']} is not a file; link to a page, a picture or a file")
    text = TARGET.sub(lambda inner: _moved(inner, file, page, pages), link["text"])
    where = os.path.relpath(pages.get(target, target), page.parent)
    download = target not in pages and not target.is_relative_to(DOCS) and not link["image"]
    return f"{link['image']}[{text}]({f'<path:{where}>' if download else where}{link['anchor'] or ''})"


def _file(beside: Path, relative: str) -> Path:
    return Path(os.path.normpath(beside.parent / relative))
