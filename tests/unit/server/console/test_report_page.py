"""A run's page: one file that needs no other, and figures that keep each extreme however long
the run was.
"""

from __future__ import annotations

import base64
import hashlib
import re

import numpy as np
import pytest

from hilstar.basics.rotation import from_radec_roll_deg, from_rotation_vector
from hilstar.server.console.report import (
    PAGE_DIR,
    faults_on,
    one_script,
    report_page,
    residuals_along,
    run_data,
    verdict,
)
from hilstar.server.record.ledger_records import CountRecord, EventRecord, FrameRecord, PacketForm
from hilstar.server.record.run_figures import (
    BLOCK,
    MAX_EVENTS,
    RunFigures,
    SpanTable,
    ThinnedRows,
    TimeBins,
    summarise,
)
from tests.support.run_page import run_data_of

PERIOD_NS = 16_666_667
MAX_PAGE_BYTES = 3_000_000  # "a few MB", without pictures
UPLOT_SHA256 = {
    "uplot.min.js": "19c8d4c6ad88929a79f4ae49d6f7161566dfd0ba3d15cc495e974f787eb78f1f",
    "uplot.min.css": "df630c6a8d6f8eeaff264b50f73ce5b114f646ffd9a0bb74f049b0a00135fa04",
}
FRAMES = 32_000  # nearly as many spans as there may be, of 4 frames each


def frame_record(k: int, **more: object) -> FrameRecord:
    swap_ns = 10**12 + k * PERIOD_NS
    turn = 1e-4 * k
    q = (np.cos(turn), 0.0, np.sin(turn), 0.0)
    known = {
        "frame": k,
        "t_ns": swap_ns,
        "light_ns": swap_ns,
        "draw_ns": swap_ns - 5_000_000,
        "swap_ns": swap_ns,
        "q": q,
    }
    return FrameRecord(
        **(known | {"age_ns": 7_000_000 + 1000 * (k % 997), "stars_drawn": 200} | more)
    )


@pytest.fixture(scope="module")
def reported_run() -> RunFigures:
    figures = RunFigures(
        {
            "unix_ns": str(1_800_000_000 * 10**9),
            "monotonic_ns": str(10**12 - 3 * 10**9),  # the first swap came 3 s later
            "bench_text": "</script>",
        }
    )
    for begin in range(0, FRAMES, BLOCK):
        block = range(begin, min(begin + BLOCK, FRAMES))
        late = {31_415: {"age_ns": 900_000_000, "stale": True, "missed_before": 3}}
        figures.add(*(frame_record(k, **late.get(k, {})) for k in block))
        figures.add(*(PacketForm(True, None, 10**12 + k * PERIOD_NS) for k in block))
    figures.add(CountRecord(host_ns=10**12 + 500 * 10**9, kind="packet", reason="crc", count=77))
    figures.add(EventRecord(host_ns=10**12 + 90 * 10**9, kind="mark", detail="<b>cover off</b>"))
    return figures


def test_the_page_stands_alone_and_lets_nothing_else_in(reported_run):
    page = report_page(run_data("run.mcap", reported_run, summarise(reported_run)))
    policy = re.search(r'Content-Security-Policy" content="([^"]+)"', page)
    script = re.search(r'<script type="module">(.*?)</script>', page, re.DOTALL)
    uplot = re.search(r"<script>(.*?)</script>", page, re.DOTALL)
    style = re.search(r"<style>(.*?)</style>", page, re.DOTALL)
    assert policy is not None and script is not None and style is not None and uplot is not None
    assert page.count("<script") == 3  # the run's data among them
    assert "default-src 'none'" in policy[1]
    scripts = f"script-src {sha256_source(uplot[1])} {sha256_source(script[1])};"
    assert scripts in policy[1]
    assert f"style-src {sha256_source(style[1])};" in policy[1]
    assert not re.search(r'(?:src|href)="(?!data:|#)', page)
    rest = page.replace(script[1], "").replace(uplot[1], "")
    assert not re.search(r"https?://(?!www\.w3\.org)", rest)
    for text in (script[1], uplot[1]):
        assert not re.search(r"fetch\(|XMLHttpRequest|WebSocket|import\(|eval\(|new Function", text)
    assert run_data_of(page)["bench_text"] == "</script>"


def sha256_source(text: str) -> str:
    """A script's or a style's source in a policy."""
    return f"'sha256-{base64.b64encode(hashlib.sha256(text.encode()).digest()).decode()}'"


def test_uplot_is_the_published_file_and_ships_with_its_licence():
    """npm's uplot 1.6.32: dist/uPlot.iife.min.js and dist/uPlot.min.css, byte for byte."""
    for name, digest in UPLOT_SHA256.items():
        assert hashlib.sha256((PAGE_DIR / name).read_bytes()).hexdigest() == digest
    licence = (PAGE_DIR / "uplot.LICENSE").read_text()
    assert licence.startswith("The MIT License (MIT)")
    assert "Leon Sorokin" in licence


def test_every_module_of_the_page_can_be_taken_into_it():
    for path in PAGE_DIR.glob("*.js"):
        assert not re.search(r"^(?:import|export)\b", one_script(path.stem), re.MULTILINE)


def test_a_long_run_keeps_its_worst_frame_and_stays_small(reported_run):
    page = report_page(run_data("run.mcap", reported_run, summarise(reported_run)))
    assert len(page) < MAX_PAGE_BYTES
    told = run_data_of(page)
    spans = told["spans"]
    low, high = (np.array(part, dtype=float) for part in spans["age"])
    worst = int(np.argmax(high))
    assert high[worst] == 900.0 and low.min() == 7.0
    begins = np.array(spans["t_s"])
    assert begins[worst] <= 31_415 * PERIOD_NS / 1e9 < begins[worst + 1]
    assert sum(spans["missed"]) == 3 and spans["missed"][worst] == 3 and sum(spans["stale"]) == 1
    assert told["events"] == [
        {
            "t_s": 90.0,
            "utc": "2027-01-15T08:01:33.000+00:00",
            "kind": "mark",
            "line": "<b>cover off</b>",
        }
    ]


def moved_run(step_ns: int, attitudes: list[np.ndarray]) -> tuple[dict, dict]:
    """The path and motion of a run whose attitudes are `step_ns` apart, shown 60 a second."""
    figures = RunFigures({})
    for k, q in enumerate(attitudes):
        figures.add(frame_record(k, q=tuple(q), t_ns=10**12 + k * step_ns))
    told = run_data("run.mcap", figures, summarise(figures))
    return told["path"], told["motion"]


def test_a_path_s_rate_is_by_the_attitudes_time_not_the_screen_s():
    turns = [from_rotation_vector(np.array([0.0, 0.0, -1e-3 * k])) for k in range(20)]
    for step_ns in (PERIOD_NS, 2 * PERIOD_NS):
        path, _ = moved_run(step_ns, turns)
        *rates, last = path["rate_deg_s"][2]
        assert last is None
        assert rates == pytest.approx([np.degrees(1e-3) / (step_ns / 1e9)] * 19, abs=2e-4)


def test_beside_a_steady_turn_a_steady_turn_is_nothing_and_a_swing_is_itself():
    """The turn of 0.04 rad about z takes that share of the swing of 1 deg to x."""
    swing_rad = np.radians(1.0) * np.cos(2 * np.pi * (np.arange(40) - 19.5) / 10)
    turns = [from_rotation_vector(np.array([0.0, swing_rad[k], -1e-3 * k])) for k in range(40)]
    _, motion = moved_run(PERIOD_NS, turns)
    x, y, z = motion["beside_steady"]["curves"].values()
    assert np.abs(x).max() < 0.04 and np.abs(z).max() < 1e-3
    assert np.ptp(y) == pytest.approx(2 * np.cos(0.1 * np.pi), abs=2e-3)


@pytest.mark.parametrize(("dec_deg", "amplitude_deg"), [(0.0, 2.0), (60.0, 1.0)])
def test_a_motion_in_right_ascension_is_as_wide_as_on_the_sky(dec_deg, amplitude_deg):
    swing_deg = 2.0 * np.sin(2 * np.pi * np.arange(40) / 40)
    attitudes = [from_radec_roll_deg(100.0 + ra_deg, dec_deg, 0.0) for ra_deg in swing_deg]
    _, motion = moved_run(PERIOD_NS, attitudes)
    curve, *others = motion["about_mean"]["curves"].values()
    assert max(curve) == pytest.approx(amplitude_deg, abs=2e-3)
    assert np.abs(others).max() < 2e-3


def test_a_fault_that_never_ended_is_on_until_the_run_s_end():
    assert faults_on([(2.0, None), (1.0, 5.0)], 9.0) == ([1.0, 2.0, 5.0, 9.0], [1, 2, 1, 0])


def test_residuals_and_wrong_answers_stand_at_their_times_in_the_run():
    assert residuals_along(np.array([[3.0, 1.0, 2.0, 4.0]]), [4 * 10**9], 10**9) == {
        "t_s": [2.0],
        "xyz_arcsec": [[1.0], [2.0], [4.0]],
        "wrong_s": [3.0],
    }


def test_packets_are_counted_at_their_time(reported_run):
    told = run_data("run.mcap", reported_run, summarise(reported_run))["packets"]
    *accepted, last = told["accepted_hz"]
    assert last is None  # the run ended before this bin did
    rate_hz = FRAMES / (told["t_s"][-1] + told["width_s"])
    assert sum(accepted) * told["width_s"] == pytest.approx(
        FRAMES, abs=2 * rate_hz * told["width_s"]
    )
    refused = {
        at: rate * told["width_s"]
        for at, rate in zip(told["t_s"], told["refused_hz"], strict=True)
        if rate
    }
    assert refused == {500.0: pytest.approx(77)}


def test_the_verdict_names_everything_that_was_wrong():
    figures = RunFigures({})
    for k, more in enumerate(
        [
            {},
            {"stale": True},
            {"q": None, "stale": True},
            {"missed_before": 2, "missed": 2},
            {"hidden": "covered", "missed": 2},
        ]
    ):
        figures.add(frame_record(k, **more))
    told = verdict(summarise(figures), figures.counted["late"])
    assert not told["ok"]
    assert told["reasons"] == [
        "1 of 5 frames without an attitude",
        "1 of 5 frames with a stale attitude",
        "1 of 5 frames not seen on the screen",
        "2 refresh periods without a frame of their own",
    ]
    assert (
        told["headline"] == "Sky was not right throughout" and told["share"] == "28.5 %"
    )  # 2 of 5 frames and 2 periods without one
    assert not told["late"]
    well = RunFigures({})
    well.add(frame_record(0))
    assert verdict(summarise(well), 0)["ok"]


def test_a_run_that_missed_frames_alone_was_late_and_right():
    figures = RunFigures({})
    figures.add(frame_record(0))
    figures.add(frame_record(1, missed_before=3, missed=3))
    told = verdict(summarise(figures), 0)
    assert not told["ok"] and told["late"]
    assert told["headline"] == "60 % of frames missed"  # 3 of 5 refresh periods


def event(k: int, kind: str, since: int | None = None) -> EventRecord:
    since_ns = None if since is None else 10**12 + since * PERIOD_NS
    return EventRecord(
        host_ns=10**12 + k * PERIOD_NS, kind=kind, detail="by a factor of 1.5", since_ns=since_ns
    )


def test_an_event_has_the_time_of_day_of_its_own_moment():
    """The head's two clocks are of 3 s before the first swap; the event came 0.1 s after that."""
    head = {"unix_ns": str(1_800_000_000 * 10**9), "monotonic_ns": str(10**12 - 3 * 10**9)}
    figures = RunFigures(head)
    figures.add(frame_record(0), event(6, "mark"))
    (told,) = run_data("run.mcap", figures, summarise(figures))["events"]
    assert (told["t_s"], told["utc"]) == (0.1, "2027-01-15T08:00:03.100+00:00")


@pytest.mark.parametrize("block", [1, 7, 1000])
def test_frames_of_a_wrong_sky_are_wrong_from_when_it_began(block):
    """It is found at frame 50, and began at 20; the frames between are in blocks before it."""
    records = [frame_record(k, stale=k == 30) for k in range(100)]
    records[51:51] = [event(50, "rates-wrong", 20)]
    records[71:71] = [event(70, "rates-right")]
    figures = RunFigures({})
    for begin in range(0, len(records), block):
        figures.add(*records[begin : begin + block])
    found = summarise(figures)
    assert (found.wrong_frames, found.right_frames) == (50, 50)
    assert found.wrong_sky.seconds == pytest.approx(50 * PERIOD_NS / 1e9, abs=1e-3)
    told = verdict(found, figures.counted["late"])
    assert "50 of 100 frames of a wrong sky" in told["reasons"]
    assert any("by a factor of 1.5" in reason for reason in told["reasons"])


def test_lost_packets_are_a_figure_of_their_own():
    figures = RunFigures({})
    figures.add(
        frame_record(0), CountRecord(host_ns=10**12, kind="lost", reason="sequence", count=3)
    )
    found = summarise(figures)
    assert (
        found.lost_packets == 3 and "lost" not in found.packets and "sequence" not in found.packets
    )


def test_thinned_rows_are_evenly_spaced_over_the_whole_stream(rng):
    for count in (1, 16, 17, 1000, 4097):
        rows = ThinnedRows(1, capacity=16)
        at = 0
        while at < count:
            end = min(count, at + int(rng.integers(1, 40)))
            rows.add(np.arange(at, end, dtype=float)[:, None])
            at = end
        assert rows.rows[:, 0].tolist() == list(range(0, count, rows.stride))
        assert len(rows.rows) <= 16


def test_spans_are_the_extremes_and_sums_of_equal_numbers_of_frames():
    rng = np.random.default_rng(5)
    for count in (1, 7, 1023, 1024, 5000, 20_001):
        values = rng.normal(size=(count, 2))
        values[rng.random(count) < 0.2, 1] = np.nan
        spans = SpanTable(2, capacity=16)
        rows = np.column_stack([np.arange(count), values])
        for at in range(0, count, 300):
            spans.add(rows[at : at + 300])
        begin, length = spans.begin, spans.length
        assert len(begin) <= 16 and begin.tolist() == list(range(0, count, length))
        for column in range(2):
            low, high, total = spans.column(column)
            parts = [values[at : at + length, column] for at in range(0, count, length)]
            assert np.array_equal(low, [np.fmin.reduce(part) for part in parts], equal_nan=True)
            assert np.array_equal(high, [np.fmax.reduce(part) for part in parts], equal_nan=True)
            assert total == pytest.approx([np.nansum(part) for part in parts])


def test_bins_keep_every_count_whatever_the_times():
    bins = TimeBins(1, capacity=8)
    for at_ns in (5 * 10**9, 0, 6 * 10**9, 2**62, 40 * 10**9):
        bins.add(np.array([at_ns]), np.array([0]))
    begin_s, rates_hz = bins.rates_hz(0)
    assert begin_s[0] == 5.0 and len(begin_s) <= 8
    assert (rates_hz * bins.width_ns / 1e9).sum() == pytest.approx(5)


def test_a_time_before_the_first_one_counts_in_the_first_bin():
    bins = TimeBins(1, capacity=8)
    for at_ns in (5 * 10**9, 0, 49 * 10**8, 6 * 10**9):
        bins.add(np.array([at_ns]), np.array([0]))
    begin_s, rates_hz = bins.rates_hz(0)
    assert begin_s.tolist() == [5.0, 6.0]
    assert rates_hz.ravel().tolist() == [3.0, 1.0]


def test_a_steady_stream_has_a_steady_rate_however_long_it_lasts():
    bins = TimeBins(1, capacity=8)
    for second in range(200):
        bins.add(np.array([second * 10**9]), np.array([0]))
    _, rates_hz = bins.rates_hz(0)
    assert (rates_hz[:-1] == 1.0).all()
    assert (rates_hz * bins.width_ns / 1e9).sum() == pytest.approx(200)


def test_of_a_flood_of_events_the_first_and_the_last_are_told():
    figures = RunFigures({})
    figures.add(frame_record(0))
    for k in range(3 * MAX_EVENTS):
        figures.add(EventRecord(host_ns=k, kind="stale", detail="x" * 10_000))
    told = run_data("run.mcap", figures, summarise(figures))
    assert len(told["events"]) == 2 * MAX_EVENTS and told["events_total"] == 3 * MAX_EVENTS
    assert max(len(event["line"]) for event in told["events"]) <= 400
