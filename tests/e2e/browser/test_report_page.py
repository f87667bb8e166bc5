"""A run's report in a browser, from a file: its pictures, its zoom, its moments, at every size,
by mouse and by keys alone.
"""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np
import pytest
from selenium.webdriver.common.action_chains import ActionChains
from selenium.webdriver.common.keys import Keys

import hilstar
from hilstar.attitude.wire.packet import decode
from hilstar.basics.notices import Notice
from hilstar.basics.palette import colours_of
from hilstar.basics.rotation import from_rotation_vector, multiply
from hilstar.server.record.ledger import Ledger
from hilstar.server.record.ledger_records import AnswerRecord, FaultRecord, FrameRecord
from tests.support.benches import ORION_Q, SMALL_BENCH
from tests.support.browser import Browser, assert_fits_every_size_in_light_and_dark
from tests.support.commands import run_hilstar_here
from tests.support.run_page import levels_of, run_data_of
from tests.support.senders import packet

pytestmark = [pytest.mark.e2e, pytest.mark.gpu]
FRAMES, PERIOD_NS = 600, 16_666_667
FAULTY = range(120, 240)
TURN_RAD = 2e-4  # a frame


def record(k: int) -> FrameRecord:
    at_ns = 10**12 + k * PERIOD_NS
    q = tuple(
        multiply(
            from_rotation_vector(np.array([0.0, TURN_RAD * k, 0.0])), np.array(ORION_Q)
        ).tolist()
    )
    age_ns = 400_000_000 if 300 <= k < 330 else 8_000_000 + 10_000 * (k % 50)
    times = {
        "t_ns": at_ns,
        "light_ns": at_ns,
        "draw_ns": at_ns - 4_000_000,
        "swap_ns": at_ns,
        "age_ns": age_ns,
    }
    missed = {"missed_before": 2 if k == 450 else 0, "missed": 2 if k >= 450 else 0}
    missed |= {"faults": (1,), "fault_since_ns": (10**12,)} if k in FAULTY else {}
    return FrameRecord(frame=k, q=q, stale=age_ns > 250_000_000, stars_drawn=200, **times, **missed)


def answer(k: int) -> AnswerRecord:
    """The tracker's answer with frame k: lost in the fault, and wrong once."""
    at_ns = 10**12 + k * PERIOD_NS
    found = AnswerRecord(
        host_ns=at_ns + 10**8,
        raw="",
        middle_ns=at_ns,
        verdict="right",
        residual_arcsec=(2.0, -3.0, 9.0),
    )
    if k in FAULTY:
        found.verdict, found.residual_arcsec, found.valid = "invalid", None, False
    elif k == 420:
        found.verdict, found.residual_arcsec = "wrong", (9e4, 0.0, 0.0)
    return found


@pytest.fixture(scope="module")
def report_file(tmp_path_factory) -> Path:
    """The report of 10 s with a stale half second, two missed periods, refused packets and a
    mark.
    """
    folder = tmp_path_factory.mktemp("run")
    (folder / "bench.toml").write_text(SMALL_BENCH)
    with hilstar.load(folder / "bench.toml") as bench, Ledger(folder / "run.mcap", bench) as ledger:
        ghost = json.dumps(
            {"kind": "false-star", "name": "ghost", "radec_deg": [84.0, -1.0], "v_mag": 2.0}
        )
        ledger.fault(
            FaultRecord(
                host_ns=1,
                event="start",
                number=1,
                name="ghost",
                kind="false-star",
                who="",
                t_ns=0,
                table=ghost,
            )
        )
        for k in range(FRAMES):
            ledger.frame(record(k))
            if k % 6 == 0:
                ledger.answer(answer(k))
                raw = packet(k, k * PERIOD_NS)
                ledger.packet(10**12 + k * PERIOD_NS, raw, decode(raw), None)
        ledger.packet(10**12 + 10**9, b"?", None, None)
        ledger.notice(Notice(10**12 + 5 * 10**9, "stale", "the attitude is stale"))
        ledger.notice(Notice(10**12 + 7 * 10**9, "mark", "<img src=x onerror=alert(1)>"))
    result = run_hilstar_here("report", folder / "run.mcap", "-o", folder / "report")
    assert result.returncode == 0, result.stderr
    return folder / "report" / "report.html"


@pytest.fixture
def sheet(page, report_file) -> Browser:
    page.get(report_file.as_uri())
    page.until("document.body.dataset.ready === 'true'")
    return page


def chart_aria(page: Browser, name: str) -> str:
    return page.run(
        f"return document.querySelector('#chart-{name} .plot').getAttribute('aria-label')"
    )


def test_it_says_what_was_wrong_and_shows_the_whole_run(sheet):
    text = {
        name: sheet.text(f"#{name}")
        for name in ("health-headline", "health-reasons", "summary", "events", "refusals")
    }
    assert text["health-headline"] == "Sky was not right throughout"
    assert (
        "30 of 600 frames with a stale attitude" in text["health-reasons"]
        and "2 refresh periods" in text["health-reasons"]
    )
    assert "<img src=x onerror=alert(1)>" in text["events"]  # as text, never as a tag
    assert "format" in text["refusals"]
    age = chart_aria(sheet, "age")
    assert "8.0 to 400.0" in age and "30 stale frames" in age
    assert "2 missed" in chart_aria(sheet, "pacing")


def test_what_comes_once_a_second_is_a_line_in_a_short_run_too(sheet):
    inked = sheet.run("""
        const canvas = document.querySelector("#chart-packets canvas");
        const {width, height} = canvas;
        const {data} = canvas.getContext("2d").getImageData(0, 0, width, height);
        const at = (x, y, part) => data[4 * (y * width + x) + part];
        const blue = (x, y) => at(x, y, 3) > 99 && at(x, y, 2) > at(x, y, 0) + 60;
        const columns = [...Array(width).keys()];
        return columns.filter((x) => [...Array(height).keys()].some((y) => blue(x, y))).length / width;
    """)
    assert inked > 0.5


def elements_shown(page: Browser, selector: str) -> int:
    """How many elements of a selector can be seen."""
    return page.run(
        "return [...document.querySelectorAll(arguments[0])].filter((one) =>"
        " one.checkVisibility()).length",
        selector,
    )


def test_on_paper_it_is_light_without_buttons_and_with_all_events(sheet):
    sheet.prefer(color_scheme="dark")
    many = (
        "const list = document.getElementById('events');"
        " for (let k = 0; k < 100; k += 1) list.append(list.lastElementChild.cloneNode(true))"
    )
    sheet.run(many)
    pressed = "button:not(.pick), select, input"
    assert elements_shown(sheet, pressed) > 10
    chart_before = sheet.run("return document.querySelector('#chart-age canvas').toDataURL()")
    sheet.paper()
    ground, panel = sheet.run(
        "const style = getComputedStyle(document.documentElement);"
        "return ['--ground', '--panel'].map((name) => style.getPropertyValue(name).trim())"
    )
    assert (ground, panel) == (colours_of("light")["ground"], colours_of("light")["panel"])
    chart_now = sheet.run("return document.querySelector('#chart-age canvas').toDataURL()")
    assert chart_now != chart_before  # drawn again in the light colours
    assert elements_shown(sheet, pressed) == 0
    cut = "const list = document.getElementById('events'); return list.scrollHeight - list.clientHeight"
    assert sheet.run(cut) <= 1
    assert elements_shown(sheet, "#events li") >= 102
    sheet.screen()
    sheet.prefer(color_scheme="dark")
    sheet.until("document.documentElement.dataset.theme === 'dark'")
    assert sheet.run(cut) > 1


def test_events_are_a_list_whose_items_hold_buttons(sheet):
    assert sheet.run("return document.querySelectorAll('#events > li[role]').length") == 0
    assert sheet.run("return document.querySelectorAll('#events > li > button').length") >= 2
    sheet.find("#events button").send_keys(Keys.ENTER)
    assert sheet.text("#attitude-state").startswith("at ")


def test_the_trackers_residual_is_charted_with_its_faults_shaded_and_their_effect_said(sheet):
    words = chart_aria(sheet, "residual")
    assert (
        "x 2.0 to 2.0" in words
        and "z 9.0 to 9.0" in words
        and "1 wrong" in words
        and "1 fault on" in words
    )
    cells = [cell.text for cell in sheet.find_elements("css selector", "#fault-table td")]
    assert cells[0] == "ghost" and cells[2] == "100.0 % / 0.0 % / 98.3 %" and cells[5] == "none"
    assert (
        "100 ms" not in sheet.text("#fault-table")
        and "tracker's answers" in sheet.text("#summary").lower()
    )


def test_a_drag_over_a_chart_looks_closer_and_every_chart_follows(sheet):
    chart = sheet.find("#chart-age .plot")
    width = chart.size["width"]
    ActionChains(sheet).move_to_element_with_offset(
        chart, -round(width * 0.3), 0
    ).click_and_hold().move_by_offset(round(width * 0.2), 0).release().perform()
    assert "of 10.0" in sheet.text("#range-text")
    assert "8.0 to 8.5" in chart_aria(sheet, "age") and "0 stale" in chart_aria(sheet, "age")
    assert "0 missed" in chart_aria(sheet, "pacing")
    sheet.find("#range-whole").click()
    assert "400.0" in chart_aria(sheet, "age")


def test_what_is_under_the_pointer_is_said_and_forgotten(sheet):
    chart = sheet.find("#chart-age .plot")
    ActionChains(sheet).move_to_element(chart).perform()
    sheet.until("document.querySelector('#chart-age .chart-text').textContent.startsWith('at 4')")
    bars = sheet.find("#distributions .plot")
    whole = sheet.text("#distributions .chart-text")
    ActionChains(sheet).move_to_element(bars).perform()
    sheet.until("document.querySelector('#chart-age .chart-text').textContent.startsWith('at 0')")
    said = sheet.text("#distributions .chart-text")
    assert said != whole and said.endswith("frames")


def test_by_keys_alone_a_chart_is_moved_over_the_run(sheet):
    sheet.run("document.querySelector('#chart-age .plot').focus()")
    for keys in ("+", "+", Keys.ARROW_RIGHT, "-", Keys.ARROW_LEFT):
        before = sheet.text("#range-text")
        ActionChains(sheet).send_keys(keys).perform()
        assert sheet.text("#range-text") != before
    ActionChains(sheet).send_keys("0").perform()
    assert "the whole run" in sheet.text("#range-text")
    outline = sheet.run("return getComputedStyle(document.activeElement).outlineStyle")
    assert outline == "solid"


def test_an_event_leads_to_its_moment_and_to_the_picture_nearest_to_it(sheet, report_file):
    sheet.run(
        "[...document.querySelectorAll('#events li')].find((row) => row.dataset.kind ==="
        " 'stale').querySelector('button').click()"
    )
    assert sheet.text("#attitude-state") == "at 5 s"
    pictures = run_data_of(report_file.read_text())["pictures"]
    nearest = min(pictures, key=lambda picture: abs(picture["t_s"] - 5.0))
    sheet.until(f"document.getElementById('picture').dataset.frame === '{nearest['frame']}'")
    assert sheet.text("#picture-badge") == "Stale attitude"


def test_single_pixels_show_the_codes_that_were_shown(sheet, report_file):
    sheet.find("#zoom-pixels").click()
    picture = next(one for one in run_data_of(report_file.read_text())["pictures"] if one["truth"])
    levels = levels_of(picture)
    sheet.until("document.getElementById('picture-text').textContent.includes('4000')")
    stage = sheet.find("#picture")
    ActionChains(sheet).move_to_element(stage).perform()
    y, x = np.unravel_index(np.argmax(levels), levels.shape)
    assert sheet.text("#pixel") == f"({x}, {y}) px: code {levels.max()}"
    ActionChains(sheet).move_by_offset(40, 0).perform()
    assert sheet.text("#pixel") == f"({x + 1}, {y}) px: code {levels[y, x + 1]}"


def test_it_fits_every_size_in_light_and_dark(sheet, tmp_path):
    assert_fits_every_size_in_light_and_dark(sheet, tmp_path)
