"""What README gives to type."""

from __future__ import annotations

import os
import re
from pathlib import Path

from tests.support.benches import ROOT

README = (ROOT / "README.md").read_text()


def blocks(language: str) -> list[str]:
    """Its blocks of code in a language, in turn."""
    return re.findall(rf"```{language}\b[^\n]*\n(.*?)```", README, re.DOTALL)


def plain_pytest(folder: Path) -> dict[str, str]:
    """The environment of a reader whose pytest has no plugins of others, and no configuration
    above the folder.
    """
    (folder / "pytest.ini").write_text("[pytest]\n")
    return os.environ | {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1"}
