"""Where the built pages link to, where a page of the checkout links to a file outside docs/."""

from __future__ import annotations

import re
from types import SimpleNamespace

import pytest

from tests.support.benches import ROOT
from tools import docs_hooks


@pytest.mark.parametrize(
    ("page", "built"),
    [
        (
            "see [the wire](../firmware_protocol/README.md#udp) first",
            "see [the wire](wire.md#udp) first",
        ),
        (
            "the [`[uniformity]`](../configs/CALIBRATION.md#the-file) map",
            "the [`[uniformity]`](calibration-files.md#the-file) map",
        ),
        ("see [the light](the-light.md)", "see [the light](the-light.md)"),
        (
            "see [changes](../CHANGELOG.md), [examples](../examples)",
            "see [changes](changes.md), [examples](examples.md)",
        ),
        (
            "copy [a sender](../examples/serial_sender.c)",
            "copy [a sender](examples/serial_sender.c)",
        ),
        ("the CSV files in [`results/`](../results)", "the CSV files in `results`"),
        ("![the sky](../readme.png)", "![the sky](readme.png)"),
        (
            '<picture><source srcset="a.png" media="(prefers-color-scheme: dark)">'
            '<img src="a-light.png" alt="the page"></picture>',
            "![the page](a-light.png#only-light) ![the page](a.png#only-dark)",
        ),
    ],
)
def test_a_link_out_of_the_documentation_leads_to_a_page_or_a_file_of_the_site(page, built):
    assert docs_hooks.on_page_markdown(page) == built


def test_a_page_from_elsewhere_links_into_the_documentation():
    page = SimpleNamespace(file=SimpleNamespace(src_uri="examples.md"))
    text = (
        "see [campaigns](../docs/campaign.md#cases) and [a"
        " header](../firmware_protocol/hilstar_protocol.h)"
    )
    built = docs_hooks.on_page_markdown(text, page=page)
    assert (
        built == "see [campaigns](campaign.md#cases) and [a"
        " header](firmware_protocol/hilstar_protocol.h)"
    )


def test_files_that_pages_link_to_are_on_the_site():
    files = docs_hooks.linked_files()
    assert {"examples/serial_sender.c", "firmware_protocol/hilstar_protocol.h"} <= files
    assert not any(path.startswith("docs/") for path in files)


OF_CONTRIBUTORS = {
    "architecture.md",
    "contributing.md",
    "thesis.md",
}  # on the site, but in no group


def test_every_page_stands_in_one_group_of_the_site():
    """As the contents of a book: no page without a group, none twice, and no group of one."""
    lines = (
        (ROOT / "mkdocs.yml").read_text().partition("\nnav:\n")[2].partition("\n\n")[0].splitlines()
    )
    groups = [line.strip(" -:") for line in lines if line.endswith(":")]
    assert groups == ["Start", "Bench", "Sky", "Run", "Prove", "Reference"]
    named = [line.rpartition(" ")[2] for line in lines if line.endswith(".md")]
    pages = {page.name for page in (ROOT / "docs").glob("*.md")} | set(docs_hooks.ADDED)
    pages -= OF_CONTRIBUTORS
    assert len(named) == len(set(named)) and set(named) == pages


PAGES_WITH_DRAWINGS = ["index", "first-day", "attitude-in", "bench-pc", "answers", "theory"]


@pytest.mark.parametrize("page", PAGES_WITH_DRAWINGS)
def test_a_drawing_is_light_and_dark(page):
    names = re.findall(r"\((drawing-[\w-]+\.svg)\)", (ROOT / "docs" / f"{page}.md").read_text())
    assert names
    for name in names:
        drawing = (ROOT / "docs" / name).read_text()
        assert "prefers-color-scheme:dark" in drawing and "<title>" in drawing


def test_a_plain_view_of_the_repository_shows_the_python_api_too():
    text = (ROOT / "docs" / "python-api.md").read_text()
    assert "\n:::" not in text and "### hilstar.load" in text and "Raises InputError" in text
