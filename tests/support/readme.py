"""What README gives to type."""

from __future__ import annotations

import re

from tests.support.benches import ROOT

README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    """Its blocks of code in a language, in turn."""
    return re.findall(rf"```{language}\b[^\n]*\n(.*?)```", README, re.DOTALL)
