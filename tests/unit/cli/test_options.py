"""Values of options: what each text means, in the unit of what it is for, and which are refused."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import pytest

from hilstar.basics.units import NS_PER_S
from hilstar.cli.options import (
    parse_at,
    parse_convention,
    parse_counts,
    parse_diode,
    parse_memory,
    parse_mounting,
    parse_place,
    parse_reading,
    parse_resolution,
    parse_share,
    parse_sizes,
    parse_speed,
    parse_spin,
    parse_split,
    with_values,
)
from hilstar.cli.serve import ServeOptions, _consoles, _exit_code, _limit
from hilstar.cli.tracker import checked_rate, parse_silent
from hilstar.instruments.calibrate.scale import StarReading
from hilstar.server.bench.config import parse_config
from hilstar.server.console import listener
from hilstar.server.console.listener import ListenAddress
from hilstar.server.record.ledger import SplitLimits
from tests.support.benches import SMALL_BENCH
from tests.support.refusals import refusal


@pytest.mark.parametrize(
    ("text", "rate_deg_s"),
    [
        ("x,2", (2.0, 0.0, 0.0)),
        ("Y,-0.5", (0.0, -0.5, 0.0)),
        ("z, 90", (0.0, 0.0, 90.0)),
        # an axis of any length says where it points, and no more
        ("0,3,4,10", (0.0, 6.0, 8.0)),
        ("-0.3,0,0,10", (-10.0, 0.0, 0.0)),
    ],
)
def test_a_spin_turns_by_its_degrees_a_second_about_its_axis(text, rate_deg_s):
    assert parse_spin(text) == pytest.approx([math.pi / 180 * rate for rate in rate_deg_s])


@pytest.mark.parametrize(
    ("parse", "text", "value"),
    [
        (parse_place, "48.1,-11.5,520", (48.1, -11.5, 520.0)),
        (parse_place, "-90,360,0", (-90.0, 360.0, 0.0)),
        (parse_convention, "scalar=last", {"scalar": "last"}),
        (
            *(parse_convention, "frame=body, direction=cam_to_icrs"),
            {"frame": "body", "direction": "cam_to_icrs"},
        ),
        (parse_resolution, "640,480", (640, 480)),
        (parse_resolution, "32768,1", (32768, 1)),
        (parse_memory, "4GB", 4_000_000_000),
        (parse_memory, "1.5 MB", 1_500_000),
        (parse_split, None, SplitLimits()),
        (parse_split, "2MB", SplitLimits(bytes=2e6)),
        (parse_split, "1000kB", SplitLimits(bytes=1e6)),
        (parse_split, "1.5GB", SplitLimits(bytes=1.5e9)),
        (parse_split, "10s", SplitLimits(seconds=10)),
        (parse_split, "30min", SplitLimits(seconds=1800)),
        (parse_split, "2h", SplitLimits(seconds=7200)),
        (parse_speed, "realtime", 1.0),
        (parse_speed, "max", math.inf),
        (parse_speed, "0.001", 0.001),
        (parse_speed, "1000", 1000.0),
        (parse_reading, "27989,1200", StarReading(27989, 1200.0)),
        (parse_reading, "27989,1200.5,3", StarReading(27989, 1200.5, 3.0)),
        (parse_sizes, "640x480,32768x1,640x480", ((640, 480), (32768, 1))),
        (parse_diode, "serial:/dev/ttyACM0@115200", ("/dev/ttyACM0", 115200)),
        (parse_silent, "3", (3.0, 5.0)),
        (parse_silent, "3s@20s", (3.0, 20.0)),
    ],
)
def test_a_value_is_what_its_text_says(parse, text, value):
    assert parse(text) == value


@pytest.mark.parametrize(
    ("text", "share"), [("5%", 0.05), ("0.05", 0.05), ("100 %", 1.0), ("1", 1.0)]
)
def test_a_share_is_a_fraction_or_per_cent(text, share):
    assert parse_share(text, "--lose") == pytest.approx(share)


def test_counts_are_each_once_in_their_order():
    assert parse_counts("100,7,100,1000", 1000) == (100, 7, 1000)


def test_a_mounting_is_a_unit_quaternion_by_option():
    mounting = parse_mounting("0.6,0,0,-0.8")
    assert mounting.q_body_to_cam == pytest.approx([0.6, 0.0, 0.0, -0.8])
    assert mounting.by_option


@pytest.mark.parametrize(
    ("parse", "text", "words"),
    [
        (parse_spin, "x,y,1", "--spin AXIS,DEG_PER_S"),
        (parse_spin, "0,0,0,1", "--spin AXIS,DEG_PER_S"),
        (parse_spin, "1,1,5", "--spin AXIS,DEG_PER_S"),
        (parse_spin, "x,-6e7", "--spin AXIS,DEG_PER_S"),  # over 1e6 rad/s, either way
        (parse_spin, "x,6e7", "--spin AXIS,DEG_PER_S"),
        (parse_place, "90.001,0,0", "a latitude from -90 to 90"),
        (parse_place, "-90.001,0,0", "a latitude from -90 to 90"),
        (parse_place, "0,360.001,0", "a longitude from -180 to 360"),
        (parse_place, "0,-180.001,0", "a longitude from -180 to 360"),
        (parse_mounting, "1,0,0,0.1", "its norm is 1.00499"),
        (parse_mounting, "0.998,0,0,0", "its norm is 0.998"),
        (parse_convention, "scalar=last,scalar=first", "each key once"),
        (parse_convention, "scalar", "each key once"),
        (parse_convention, "order=last", "each key once"),
        (parse_convention, "scalar=middle", "scalar is first or last"),
        (parse_resolution, "32769,480", "--resolution W,H in pixels"),
        (parse_resolution, "0.5,480", "--resolution W,H in pixels"),
        (parse_resolution, "640,32769", "--resolution W,H in pixels"),
        (parse_resolution, "640,0", "--resolution W,H in pixels"),
        (parse_memory, "4TB", "a size such as 4GB or 500MB"),
        (parse_memory, "0GB", "a size such as 4GB or 500MB"),
        (parse_split, "999kB", "1 MB or 10 s at minimum"),
        (parse_split, "9.9s", "1 MB or 10 s at minimum"),
        (parse_speed, "0.0009", "from 0.001 to 1000"),
        (parse_speed, "1001", "from 0.001 to 1000"),
        (parse_reading, "27989,0", "write --reading HIP,DN"),
        (parse_reading, "27989,5,-1", "write --reading HIP,DN"),
        (parse_reading, "27989,5,1,2", "write --reading HIP,DN"),
        (parse_sizes, "640x32769", "up to 32768 px"),
        (parse_sizes, "640x480,32769x480", "up to 32768 px"),
        (parse_silent, "soon", "such as 5s or 5s@20s"),
    ],
)
def test_a_value_that_is_none_is_refused_with_what_to_write(parse, text, words):
    assert words in refusal(parse, text)


@pytest.mark.parametrize("text", ["100.1%", "1.01", "-1%", "five"])
def test_a_share_beyond_the_whole_is_refused(text):
    assert "--lose" in refusal(parse_share, text, "--lose")


@pytest.mark.parametrize("text", ["0", "1001", "10,x", "1e2"])
def test_counts_beyond_the_largest_are_refused(text):
    assert "whole numbers from 1 to 1000" in refusal(parse_counts, text, 1000)


def test_a_moment_is_nanoseconds_and_only_where_something_moves(tmp_path):
    still = parse_config(tmp_path / "bench.toml", SMALL_BENCH)
    assert parse_at("frame", None, still) is None
    assert parse_at("frame", 1.5, still, timed=True) == 1_500_000_000
    assert parse_at("frame", -1e10, still, timed=True) == -(10**10) * NS_PER_S
    for at_s in (1.1e10, -1.1e10, math.nan):
        assert "1e10 at most" in refusal(parse_at, "frame", at_s, still, timed=True)
    assert "nothing moves in this sky" in refusal(parse_at, "frame", 1.5, still)


@pytest.mark.parametrize(
    ("options", "slots", "frames"),
    [
        (ServeOptions(bench_file=None), math.inf, math.inf),
        (ServeOptions(bench_file=None, duration=2.5), 150, math.inf),
        (ServeOptions(bench_file=None, duration=0.999), 60, math.inf),
        (ServeOptions(bench_file=None, frames=7), math.inf, 7),
    ],
)
def test_a_run_s_duration_is_refresh_periods(options, slots, frames):
    limit = _limit(options, refresh_hz=60.0)
    assert (limit.slots, limit.frames) == (slots, frames)


@pytest.mark.parametrize(
    ("codes", "exit_code"),
    [
        ((0, 0), 0),
        ((4, 0), 0),  # one head had an attitude
        ((4, 4), 4),
        ((0, 3), 3),
        ((2, 3), 2),
        ((3, 0, 1), 3),
        ((2, 4), 2),
        ((0, -9), 1),  # a signal is none of a command's codes
        ((-2, 3), 1),
        ((77, 0), 1),
    ],
)
def test_heads_end_with_the_code_of_the_first_that_failed(codes, exit_code):
    assert _exit_code(codes) == exit_code


def test_a_tracker_s_exposures_neither_overlap_nor_collect_nothing():
    assert checked_rate(None, 0.05) == 10.0
    assert checked_rate(None, 0.4) == 2.5
    assert checked_rate(2.5, 0.4) == 2.5
    assert checked_rate(0.01, 0.4) == 0.01
    assert checked_rate(1000.0, 1e-4) == 1000.0
    assert "0.01 to 1000 Hz" in refusal(checked_rate, 1001.0, 1e-4)
    assert "0.01 to 2.5 Hz" in refusal(checked_rate, 2.51, 0.4)
    assert "0.01 to" in refusal(checked_rate, 0.009, 0.4)
    assert "exposure_s = 0" in refusal(checked_rate, None, 0.0)


def test_pages_of_heads_have_ports_one_after_another_or_each_the_system_s(monkeypatch):
    tried = []

    @contextmanager
    def listens(address: ListenAddress, token: str | None) -> Iterator[None]:
        tried.append((address.host, address.port, token))
        yield

    monkeypatch.setattr(listener, "PageListener", listens)
    assert _consoles("[::1]:7000", "word", 3) == ("[::1]:7000", "[::1]:7001", "[::1]:7002")
    assert tried == [("::1", port, "word") for port in (7000, 7001, 7002)]
    assert _consoles("127.0.0.1:0", None, 2) == ("127.0.0.1:0",) * 2
    assert _consoles(None, None, 2) == ()
    assert "as many ports" in refusal(_consoles, "127.0.0.1:65535", None, 2)
    # the last port there is
    assert _consoles("127.0.0.1:65535", None, 1) == ("127.0.0.1:65535",)


def test_darks_stands_before_each_of_its_files_up_to_the_next_option():
    words = ["photon-transfer", "--darks", "a", "b", "c", "--flats", "d", "e"]
    wanted = "photon-transfer --darks a --darks b --darks c --flats d e"
    assert with_values(words) == wanted.split()
    assert with_values(["x", "--darks", "a"]) == ["x", "--darks", "a"]
