"""hilstar is under the MIT licence: nothing that `pip install .` pulls is under the GPL, AGPL or
LGPL.
"""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from tests.support.licences import UNKNOWN, is_copyleft, pulled_by

ROOT = Path(__file__).parents[2]


def test_nothing_that_the_package_requires_is_under_the_gpl():
    required = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]["dependencies"]
    licences = pulled_by(required)
    assert len(licences) > len(required)  # what those require is among them
    assert {
        name: licence
        for name, licence in licences.items()
        if licence == UNKNOWN or is_copyleft(licence)
    } == {}


@pytest.mark.parametrize(
    ("licence", "copyleft"),
    [
        ("License :: OSI Approved :: GNU General Public License v3 or later (GPLv3+)", True),
        ("AGPL-3.0-only", True),
        ("LGPL-2.1-or-later", True),
        ("GNU Lesser General Public License v3", True),
        ("MIT AND GPL-2.0-only", True),
        ("MIT OR GPL-2.0-only", False),
        ("BSD-3-Clause AND 0BSD AND MIT AND Zlib AND CC0-1.0", False),
        ("MIT", False),
    ],
)
def test_what_counts_as_of_the_gpls_family(licence, copyleft):
    assert is_copyleft(licence) == copyleft
