"""What the built pages say where a page of the checkout links to a file outside docs/."""

from __future__ import annotations

import importlib

import pytest

from tests.support.benches import ROOT


@pytest.mark.parametrize(
    ("page", "built"),
    [
        ("see [the wire](../firmware_protocol/README.md#keys) first", "see the wire (`firmware_protocol/README.md`) first"),
        ("see [CALIBRATION.md](../configs/CALIBRATION.md)", "see `configs/CALIBRATION.md`"),
        ("see [the light](the-light.md)", "see [the light](the-light.md)"),
    ],
)
def test_a_link_out_of_the_documentation_names_the_file(monkeypatch, page, built):
    monkeypatch.syspath_prepend(ROOT / "docs")
    assert importlib.import_module("hooks").on_page_markdown(page) == built
