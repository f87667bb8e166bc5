"""What mkdocs does besides: the changelog and the examples become pages, and links out of docs/
name the file.

The built pages stand alone; on a checkout such a link is followed, and tests/docs checks that it
leads somewhere.
"""

from __future__ import annotations

import posixpath
import re
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from mkdocs.structure.files import Files

ROOT = Path(__file__).resolve().parents[1]
# pages of the site, and the files that they are
ADDED = {"changes.md": "CHANGELOG.md", "examples.md": "examples/README.md"}
PICTURE = "readme.png"  # beside the README, and on the site
# its words may have brackets
LINK = re.compile(r"(?<!!)\[((?:[^\]\[]|\[[^\]\[]*\])+)\]\(([^)\s#:]+)(#[^)\s]*)?\)")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages, and the picture, that lie elsewhere in the checkout."""
    from mkdocs.structure.files import File  # which the tests of the rest do without

    for page, path in ADDED.items():
        files.append(
            File.generated(config, page, content=(ROOT / path).read_text(encoding="utf-8"))
        )
    files.append(File.generated(config, PICTURE, content=(ROOT / PICTURE).read_bytes()))
    return files


def on_page_markdown(markdown: str, page: Any = None, **_: Any) -> str:
    """A page's text with each link as the site has it: to a page, or as "words (`PATH`)" to any
    other file.
    """
    source = (
        "docs/x.md" if page is None else ADDED.get(page.file.src_uri, f"docs/{page.file.src_uri}")
    )

    def linked(link: re.Match[str]) -> str:
        text, heading = link[1], link[3] or ""
        path = posixpath.normpath(posixpath.join(posixpath.dirname(source), link[2]))
        if path.startswith("docs/"):
            return f"[{text}]({path.removeprefix('docs/')}{heading})"
        site = next(
            (name for name, file in ADDED.items() if path in {file, posixpath.dirname(file)}), None
        )
        if site is not None:
            return f"[{text}]({site}{heading})"
        return f"`{path}`" if path.endswith(text.strip("`")) else f"{text} (`{path}`)"

    return LINK.sub(linked, markdown).replace(f"](../{PICTURE})", f"]({PICTURE})")
