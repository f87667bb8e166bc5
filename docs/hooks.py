"""What mkdocs does besides: links out of docs/ name the file, for the built pages stand alone.

On a checkout such a link is followed; tests/docs checks that it leads somewhere.
"""

from __future__ import annotations

import re
from typing import Any

OUTSIDE = re.compile(r"\[([^\]\[]+)\]\(\.\./([^)\s#]+)(?:#[^)\s]*)?\)")


def _named(link: re.Match[str]) -> str:
    text, path = link[1], link[2]
    return f"`{path}`" if path.endswith(text.strip("`")) else f"{text} (`{path}`)"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """A page's text with `[words](../PATH)` as "words (`PATH`)"."""
    return OUTSIDE.sub(_named, markdown)
