"""How a refusal quotes, counts and guesses."""

from __future__ import annotations

import time

import pytest

from hilstar.basics import notices
from hilstar.basics.errors import CUT, did_you_mean, printable, shortened, size_text


@pytest.mark.parametrize(
    ("size_bytes", "text"),
    [
        (0, "0 bytes"),
        (999, "999 bytes"),
        (1000, "1 kB"),
        (1_234_567, "1.235 MB"),
        (10**9, "1 GB"),
        (1_500_000_000_000, "1500 GB"),
    ],
)
def test_a_size_is_in_the_largest_unit_that_it_fills(size_bytes, text):
    assert size_text(size_bytes) == text


@pytest.mark.parametrize("limit", [20, 21, 22])
def test_a_long_text_is_cut_to_its_limit_with_more_of_its_beginning(limit):
    text = "".join(chr(ord("a") + k % 26) for k in range(100))
    short = shortened(text, limit)
    begin, end = short.split(CUT)
    assert len(short) == limit
    assert text.startswith(begin) and text.endswith(end)
    assert len(end) == (limit - len(CUT)) // 3
    assert shortened(text, 100) == text
    assert shortened(10**5000) == "a number of thousands of digits"


def test_what_cannot_be_printed_is_escaped():
    assert printable("\udc80\udc7f\udd00") == r"\x80\udc7f\udd00"
    assert printable("a b\t\x7f\udcff\ud800é\u2028") == r"a b\x09\x7f\xff\ud800é\u2028"


def test_the_nearest_word_is_asked_after_in_its_own_letters():
    assert did_you_mean("FRAMES", ["frame", "Lens"]) == "did you mean frame? "
    assert did_you_mean("lense", ["frame", "Lens"]) == "did you mean Lens? "
    assert did_you_mean("camera", ["frame", "Lens"]) == ""


def test_a_line_of_the_log_has_the_time_of_utc(monkeypatch):
    monkeypatch.setenv("TZ", "XXX-05:30")
    time.tzset()
    try:
        before_s = time.time()
        stamp = notices.at_now("begun")
    finally:
        monkeypatch.undo()
        time.tzset()
    utc = {time.strftime("%H:%M:%S", time.gmtime(before_s + late_s)) for late_s in (0, 1)}
    assert stamp[:8] in utc
    assert stamp[8] == "." and stamp[9:12].isdigit() and stamp[12:] == "Z begun"
