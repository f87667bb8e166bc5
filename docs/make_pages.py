"""The generated pages: `python docs/make_pages.py` writes them; tests/docs fails where one is not what this makes."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import command_page

from hilstar.bench.config import reference

HERE = Path(__file__).parent
PAGES: dict[str, Callable[[], str]] = {"bench-file.md": reference.page, "commands.md": command_page.page}


if __name__ == "__main__":
    for name, make in PAGES.items():
        (HERE / name).write_text(make(), encoding="utf-8")
