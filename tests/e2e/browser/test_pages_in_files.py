"""Pages that are one file, in chromium: the page of a first-light session on a phone, at a desk
and on paper.
"""

from __future__ import annotations

import base64
import json
import re

import pytest

from tests.support.benches import TWIN, bench_text
from tests.support.commands import run_hilstar_here

PHONE_PX, DESK_PX = (360, 740), (1280, 800)
A4_PX = (718, 1047)  # within margins of 14 mm, CSS pixels
WARM_UP = "\n[certify.virtual]\ncold_percent = 3.0\nwarm_up_min = 2.0\n"


@pytest.fixture(scope="module")
def session(tmp_path_factory):
    """A session with a monitor that warms up; without a photodiode and the response, so that
    three steps measure nothing.
    """
    folder = tmp_path_factory.mktemp("pages")
    (folder / "bench.toml").write_text(bench_text(TWIN))
    (folder / "truth.toml").write_text(bench_text(TWIN, {"monitor": {"flip_x": True}}) + WARM_UP)
    done = run_hilstar_here(
        f"first-light {folder}/bench.toml -o {folder}/s --virtual {folder}/truth.toml "
        "--patches 0 --json"
    )
    assert done.returncode == 0, done.stderr
    return folder / "s" / "first-light.html", json.loads(done.stdout)["steps"]


def test_each_step_has_its_card_verdict_and_number(page, session):
    path, steps = session
    page.get(path.as_uri())
    for step in steps:
        card = f"#{step['name']}"
        words = {"done": "passed", "skipped": "not measured", "failed": "failed"}[step["verdict"]]
        assert page.text(f"{card} .chip") == words
        number = page.text(f"{card} .number")
        if step["number"] is None:
            assert step["verdict"] == "skipped" and number.startswith("\N{EM DASH}")
        else:
            assert step["number"]["of"] in number and step["number"]["unit"] in number
            assert ("\N{PLUS-MINUS SIGN}" in number) == (step["number"]["error"] is not None)
        assert page.run(
            "return document.querySelectorAll(arguments[0] + ' > figure').length", card
        ) == bool(step["pictures"])
        assert not page.run("return document.querySelector(arguments[0] + ' details').open", card)
    assert page.text(".health").startswith("What was measured is in order")


def test_the_planted_warm_up_comes_back_within_its_errors(session):
    found = next(step for step in session[1] if step["name"] == "warm-up")["figures"]
    assert found["law"] == "exponential" and found["stable"] == "yes"
    off_s = found["stable_after_s"] - found["truth_stable_after_s"]
    assert abs(off_s) < 3 * found["stable_after_error_s"] < 60
    assert (
        abs(found["drift_percent_per_h"] - found["truth_drift_percent_per_h"])
        < 3 * found["drift_error_percent_per_h"]
    )


@pytest.mark.parametrize("scheme", ["light", "dark"])
@pytest.mark.parametrize("size_px", [PHONE_PX, DESK_PX], ids=["phone", "desk"])
def test_nothing_reaches_out_of_the_window_or_the_file(page, session, size_px, scheme):
    path, _ = session
    page.size(*size_px)
    page.prefer(color_scheme=scheme)
    page.get(path.as_uri())
    page.run("document.querySelectorAll('details').forEach(each => { each.open = true })")
    assert page.overflowing() == []
    assert page.run("return document.documentElement.scrollWidth") <= size_px[0]
    assert (
        page.run(
            "return performance.getEntriesByType('resource').filter(each =>"
            " !each.name.startsWith('data:')).length"
        )
        == 0
    )
    assert not re.search(r"(?:src|href|url)\s*[=(]\s*['\"]?(?!data:|#)[\w/.]", path.read_text())
    assert page.run(
        "return [...document.images].every(each => each.complete && each.naturalWidth > 0)"
    )
    ground = page.run("return getComputedStyle(document.body).backgroundColor")
    assert ground == {"light": "rgb(238, 241, 246)", "dark": "rgb(10, 13, 19)"}[scheme]


def test_printed_on_a4_no_picture_is_cut(page, session):
    page.get(session[0].as_uri())
    page.size(*A4_PX)
    page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": "print"})
    heights = page.run(
        "return [...document.querySelectorAll('.card, figure')].map(each =>"
        " each.getBoundingClientRect().height)"
    )
    whole = page.run(
        "return getComputedStyle(document.querySelector('.card.pictured')).breakInside"
    )
    wide = page.run("return document.documentElement.scrollWidth")
    page.execute_cdp_cmd("Emulation.setEmulatedMedia", {"media": ""})
    assert whole == "avoid" and wide <= A4_PX[0]
    assert 0 < max(heights) < A4_PX[1]
    pdf = base64.b64decode(
        page.execute_cdp_cmd(
            "Page.printToPDF", {"preferCSSPageSize": True, "printBackground": True}
        )["data"]
    )
    assert pdf.startswith(b"%PDF") and 3 <= len(re.findall(rb"/Type\s*/Page\b", pdf)) <= 8
