"""What mkdocs does besides: files elsewhere in the checkout that pages link to, and the README's
picture, stand on the site too.

Texts become pages (`ADDED`), any other file is served as it is, and a folder without a page is
named. On a checkout such a link is followed, and tests/docs checks that it leads somewhere.
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
ADDED = {
    "bench-files.md": "configs/README.md",
    "calibration-files.md": "configs/CALIBRATION.md",
    "changes.md": "CHANGELOG.md",
    "contributing.md": "CONTRIBUTING.md",
    "examples.md": "examples/README.md",
    "wire.md": "firmware_protocol/README.md",
}
PICTURE = "readme.png"  # beside the README, and on the site
# a picture in the reader's colours; on the site those of the theme's own button
SCREENSHOT = re.compile(
    r'<picture><source srcset="([^"]+)" media="[^"]+"><img src="([^"]+)" alt="([^"]+)"></picture>'
)
BOTH_SCREENSHOTS = r"![\3](\2#only-light) ![\3](\1#only-dark)"
# its words may have brackets
LINK = re.compile(r"(?<!!)\[((?:[^\]\[]|\[[^\]\[]*\])+)\]\(([^)\s#:]+)(#[^)\s]*)?\)")


def on_files(files: Files, config: Any) -> Files:
    """Add the pages, the picture and the linked files that lie elsewhere in the checkout."""
    from mkdocs.structure.files import File  # which the tests of the rest do without

    for page, path in ADDED.items():
        files.append(
            File.generated(config, page, content=(ROOT / path).read_text(encoding="utf-8"))
        )
    for path in sorted({PICTURE, *linked_files()}):
        files.append(File.generated(config, path, content=(ROOT / path).read_bytes()))
    return files


def linked_files() -> set[str]:
    """The files outside docs/ that pages link to and that are no pages themselves."""
    sources = [f"docs/{page.name}" for page in (ROOT / "docs").glob("*.md")]
    found = set()
    for source in [*sources, *ADDED.values()]:
        for link in LINK.finditer((ROOT / source).read_text(encoding="utf-8")):
            path = in_checkout(source, link[2])
            is_page = path.startswith("docs/") or path in ADDED.values()
            if (ROOT / path).is_file() and not is_page:
                found.add(path)
    return found


def in_checkout(source: str, link: str) -> str:
    """The path in the checkout that a link of the file `source` leads to."""
    return posixpath.normpath(posixpath.join(posixpath.dirname(source), link))


def on_page_markdown(markdown: str, page: Any = None, **_: Any) -> str:
    """A page's text with each link as the site has it: to a page or a file, or as "words (`PATH`)"
    to a folder that has no page.
    """
    source = (
        "docs/x.md" if page is None else ADDED.get(page.file.src_uri, f"docs/{page.file.src_uri}")
    )

    def linked(link: re.Match[str]) -> str:
        text, heading = link[1], link[3] or ""
        path = in_checkout(source, link[2])
        if path.startswith("docs/"):
            return f"[{text}]({path.removeprefix('docs/')}{heading})"
        site = next(
            (name for name, file in ADDED.items() if path in {file, posixpath.dirname(file)}), None
        )
        if site is not None:
            return f"[{text}]({site}{heading})"
        if (ROOT / path).is_file():
            return f"[{text}]({path})"
        return f"`{path}`" if path.endswith(text.strip("`/")) else f"{text} (`{path}`)"

    on_site = LINK.sub(linked, markdown).replace(f"](../{PICTURE})", f"]({PICTURE})")
    return SCREENSHOT.sub(BOTH_SCREENSHOTS, on_site)
