"""The generated pages and drawings: `python tools/make_pages.py` writes them; tests/docs fails
where one is old.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import api_page
import claims
import command_page
import drawings

from hilstar.server.bench.config import reference

DOCS = Path(__file__).resolve().parents[1] / "docs"
PAGES: dict[str, Callable[[], str]] = {
    "bench-file.md": reference.page,
    "claims.md": claims.page,
    "commands.md": command_page.page,
    "python-api.md": api_page.page,
    **drawings.DRAWINGS,
}


if __name__ == "__main__":
    for name, make in PAGES.items():
        (DOCS / name).write_text(make(), encoding="utf-8")
