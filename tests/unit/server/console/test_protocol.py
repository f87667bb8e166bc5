"""What the page and its server say to each other: one definition, from which the page's
constants are made.
"""

from __future__ import annotations

import importlib
import json
import re

import msgspec
import pytest

from hilstar.server.console.protocol import (
    ChartPoint,
    EventLine,
    Hello,
    OrderBody,
    PageState,
    PageText,
    PageWants,
    PictureFormat,
    SkyHealth,
    StarMark,
    Truth,
)
from hilstar.server.console.report import PAGE_DIR
from tests.support.benches import ROOT

# A function of the page that takes an object apart, and what it is given.
TAKEN_APART = {
    ("health.js", "hear"): PageState,
    ("controls.js", "hear"): PageState,
    ("controls.js", "setUp"): Hello,
    ("overlays.js", "drawAnswer"): Truth,
    ("panels.js", "addEvent"): EventLine,
    ("main.js", "tellFrame"): PageState,
}


def field_names(struct: type[msgspec.Struct]) -> list[str]:
    return [field.name for field in msgspec.structs.fields(struct)]


def test_the_pages_constants_are_those_of_the_protocol(monkeypatch):
    """`python tools/make_page_protocol.py` has nothing to change."""
    monkeypatch.syspath_prepend(ROOT / "tools")
    tool = importlib.import_module("make_page_protocol")
    assert tool.OUTPUT.read_text(encoding="utf-8") == tool.page_protocol()


@pytest.mark.parametrize(("place", "struct"), TAKEN_APART.items())
def test_the_page_takes_apart_only_what_its_server_sends(place, struct):
    file, function = place
    found = re.search(rf"\b{function}\(\{{ ([^}}]+) \}}", (PAGE_DIR / file).read_text())
    assert found, f"{function} of {file} takes no object apart any more"
    assert {part.split(":")[0].strip() for part in found[1].split(",")} <= set(field_names(struct))


def test_the_page_hears_every_key_of_a_message():
    heard = re.search(
        r"const HEARD = \{\n(.*?)\n\};", (PAGE_DIR / "main.js").read_text(), re.DOTALL
    )
    assert re.findall(r"^  (\w+)\(", heard[1], re.MULTILINE) == field_names(PageText)


def test_the_documentation_names_every_field():
    page = (ROOT / "docs" / "console.md").read_text()
    rows = {row.split("|")[1]: row for row in page.splitlines() if row.startswith("| `")}
    for key, struct in (("hello", Hello), ("state", PageState), ("event", EventLine)):
        assert set(re.findall(r"`(\w+)`", rows[f" `{key}` "])) >= set(field_names(struct))
    assert set(re.findall(r"`(\w+)`", rows[" `history`, `point` "])) >= set(field_names(ChartPoint))
    assert f"`[{', '.join(field_names(StarMark))}]`" in rows[" `truth` "]
    for struct in (PageWants, PictureFormat, SkyHealth):
        assert all(re.search(rf"[`\"]{name}[`\"]", page) for name in field_names(struct))
    assert all(f'"{name}"' in page for name in field_names(OrderBody))


def test_a_message_has_only_what_it_says_and_no_number_that_json_lacks():
    point = PageText(point=ChartPoint(t_s=1.5, age_ms=float("nan"), frame_ms=float("inf")))
    assert json.loads(point.json()) == {
        "point": (
            dict.fromkeys(field_names(ChartPoint))
            | {
                "t_s": 1.5,
                "missed": 0,
                "refused": 0,
                "wrong": 0,
            }
        ),
    }
    truth = PageText(truth=Truth(frame=3, stars=[StarMark(1.0, 2.0, None, 26311, "\u03b5 Ori", 1)]))
    assert json.loads(truth.json()) == {
        "truth": {"frame": 3, "stars": [[1.0, 2.0, None, 26311, "\u03b5 Ori", 1, ""]]}
    }
