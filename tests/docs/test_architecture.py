"""The architecture page names what is there: its files and its floors."""

from __future__ import annotations

import re
import tomllib

import pytest

from tests.support.benches import ROOT

PAGE = (ROOT / "docs" / "architecture.md").read_text()
MAX_FILES = {"One packet to a pixel": 15, "One magnitude to a code value": 23}


def walk(heading: str) -> list[str]:
    """The files that a walk passes, each once, in order."""
    section = PAGE.split(f"\n## {heading}\n")[1].split("\n## ")[0]
    return list(
        dict.fromkeys(re.findall(r"`((?:[a-z0-9_]+/)+[a-z0-9_]+\.(?:py|vert|frag))`", section))
    )


@pytest.mark.parametrize("heading", MAX_FILES)
def test_a_walk_passes_files_that_are_there_and_few(heading):
    files = walk(heading)
    assert len(files) > 5
    for name in files:
        assert (ROOT / name).is_file() or (ROOT / "hilstar" / name).is_file(), (
            f"architecture.md names {name}"
        )
    assert len(files) <= MAX_FILES[heading]


def rooms(names: list[str]) -> set[str]:
    return {name for name in names if (ROOT / "hilstar" / name).is_dir()}


def test_the_floors_are_those_of_the_import_rules():
    """The rooms, from the top; single files may come and go."""
    rules = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["importlinter"][
        "contracts"
    ]
    layers = next(rule["layers"] for rule in rules if rule.get("containers") == ["hilstar"])
    floors = [rooms(re.findall(r"\w+", layer)) for layer in layers]
    table = PAGE.split("\n## The rooms\n")[1].split("\n## ")[0]
    rows = [
        rooms(re.findall(r"`(\w+)`", line.split("|")[1]))
        for line in table.splitlines()
        if line.startswith("| `")
    ]
    assert [row for row in rows if row] == [floor for floor in floors if floor]
