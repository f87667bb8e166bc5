"""What tests of commands share."""

from __future__ import annotations

from pathlib import Path

import pytest


@pytest.fixture
def no_opengl(tmp_path: Path) -> dict[str, str]:
    """For an environment whose loader finds a libEGL that it cannot load."""
    folder = tmp_path / "broken"
    folder.mkdir()
    (folder / "libEGL.so.1").write_text("no library")
    return {"LD_LIBRARY_PATH": str(folder)}
