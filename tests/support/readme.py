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
    """The environment of a reader whose pytest has hilstar's plugin and no others', and no
    configuration above the folder, whose own stays.
    """
    configuration = folder / "pytest.ini"
    if not configuration.exists():
        configuration.write_text("[pytest]\n")
    plugins = {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "PYTEST_PLUGINS": "hilstar.pytest_plugin"}
    return os.environ | plugins
